"""Devices, errors, threads and memory."""

import gc
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import stokescope as ss


def spike():
    """A PSF of one pixel."""
    psf = np.zeros((64, 64))
    psf[32, 32] = 1
    return psf


def test_a_device_of_arrays_is_that_of_its_bundle(capture, bundle):
    psf = np.load(bundle / "psf.npy")
    device = ss.Device(psf, ss.stripes([0, 45, 90, 135], 16), black_level=1024, noise=(0.001, 1e-6))
    assert (device.size, device.frame, device.channels, device.angles) == ((64, 64), (64, 64), 1, (0.0, 45.0, 90.0, 135.0))
    of = lambda device: ss.Pipeline(device, iterations=5)(capture.raw, capture.guide).stokes
    assert np.array_equal(of(device), of(ss.Device.load(bundle)))
    column = np.arange(64) * 16 // 64 % 4
    turns = np.deg2rad(45.0 * (np.arange(4)[:, None] - column[None]))
    maps = np.repeat((np.cos(turns) ** 2)[:, None], 64, 1)
    measured = of(ss.Device(psf, ss.measured(maps, [0, 45, 90, 135]), black_level=1024, noise=(0.001, 1e-6)))
    assert np.abs(measured - of(device)).max() < 1e-3


def test_without_a_mask_there_is_no_polarization(capture, bundle):
    r = ss.Pipeline(ss.Device(np.load(bundle / "psf.npy"), black_level=1024), iterations=3)(capture.raw, capture.guide)
    assert r.stokes.shape == (1, 64, 64) and (r.angles, r.dolp, r.aolp) == (None, None, None)


def test_a_crop_is_worked_with(bundle):
    device = ss.Device(np.load(bundle / "psf.npy"), frame=(80, 96), crop=(16, 8, 64, 64))
    assert (device.size, device.frame) == ((64, 64), (80, 96))
    raw = np.random.default_rng(1).integers(100, 60000, (80, 96))
    cut = ss.Pipeline(device, guided=False, iterations=2)(raw).stokes
    assert cut.shape == (1, 64, 64)


def test_dolp_and_aolp_are_those_of_the_stokes_images(capture):
    r = ss.Pipeline(capture.device, iterations=8)(capture.raw, capture.guide)
    s0, s1, s2 = r.stokes.astype(float)
    assert np.allclose(r.dolp[s0 > 0], (np.hypot(s1, s2)[s0 > 0] / s0[s0 > 0]), rtol=1e-5)
    off = (r.aolp - np.degrees(np.arctan2(s2, s1)) / 2 + 90) % 180 - 90
    assert np.abs(off).max() < 1e-3 and r.aolp.min() >= 0 and r.aolp.max() < 180
    assert r.dolp.dtype == r.aolp.dtype == np.float32 and r.valid.dtype == bool and r.valid.mean() > 0.9
    assert np.array_equal(r.intensity, r.stokes[0])


def test_readings_are_what_the_stokes_images_explain(capture):
    """Fractions of full scale less the black level; without the light from beyond the frame, where there is such light."""
    light = lambda capture: (capture.raw - 1024.0) / 64511
    readings = ss.Pipeline(capture.device, iterations=2)(capture.raw, capture.guide).readings
    assert readings.dtype == np.float32 and readings.shape == (64, 64) and np.abs(readings - light(capture)).max() < 1e-6
    lit = ss.simulate("wedges", size=64, noise=0.001)
    readings = ss.Pipeline(lit.device, iterations=2)(lit.raw, lit.guide).readings
    beyond = light(lit) - readings
    assert beyond.min() > -1e-6 and 0.1 < beyond.mean() / light(lit).mean() < 0.4
    colours = ss.simulate("spheres", size=(48, 40), color="rgb", stripes=8)
    assert ss.Pipeline(colours.device, iterations=2)(colours.raw, colours.guide).readings.shape == (3, 40, 48)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda p, c: p(c.raw[:32], c.guide), "raw frame has 1 channel.* of 64×32 pixels, the bundle is for 1 of 64×64"),
        (lambda p, c: p(c.raw, c.guide[::2]), "guide"),
        (lambda p, c: p(c.raw[0], c.guide), r"raw: shape \[64\], allowed: \[H, W\], "),
        (lambda p, c: p(np.zeros((4, 64, 64)), c.guide), r"raw: shape \[4, 64, 64\], allowed"),
        (lambda p, c: p(np.zeros((0, 64)), c.guide), r"raw: shape \[0, 64\], allowed"),
        (lambda p, c: p(c.raw > 0, c.guide), "raw: data type bool, allowed: integers"),
        (lambda p, c: p(c.raw * 1j, c.guide), "raw: data type complex128"),
        (lambda p, c: p(np.array([["a"]]), c.guide), "raw: data type <U1"),
        (lambda p, c: p(c.raw.astype(int) - 70000, c.guide), "raw: counts from -.* to .*, allowed: 0 to 65535"),
        (lambda p, c: p(np.full((64, 64), np.nan), c.guide), "none of the 4096 readings can be used .* 100.0 % NaN"),
        (lambda p, c: p(c.raw, c.guide, unit="lux"), "unit = 'lux', allowed: 'counts', 'full-scale'"),
        (lambda p, c: p(c.raw.astype(float), c.guide), "floating-point .* allowed: fractions of full scale"),
        (lambda p, c: ss.Pipeline(p.device, iterations=0), "iterations = 0, allowed: 1 or more"),
        (lambda p, c: ss.Pipeline(p.device, threads=0), "threads = 0, allowed: 1 to 64"),
        (lambda p, c: ss.Pipeline(p.device, method="best"), "best"),
        (lambda p, c: ss.Pipeline(p.device, fusion="smal"), "fusion model smal: neither shipped nor in"),
        (lambda p, c: ss.Pipeline(p.device, precision="f16"), "precision = \"f16\", allowed: f32, int8"),
        (lambda p, c: ss.Pipeline(p.device, guided=False, method="guided"), "method guided needs a guide frame"),
        (lambda p, c: ss.Device(np.zeros((64, 64))), "no light"),
        (lambda p, c: ss.Device(spike(), ss.stripes([0, 90], 16)), "needs at least 3"),
        (lambda p, c: ss.Device(spike(), ss.measured(np.ones((3, 8, 8)), [0, 45, 90])), "8×8"),
        (lambda p, c: ss.Device(spike(), black_level=9, saturation=3), "saturation above the black level"),
        (lambda p, c: ss.Device.load("nowhere"), "nowhere/calibration.toml: no such file"),
        (lambda p, c: ss.simulate("plastik"), "plastik"),
        (lambda p, c: ss.simulate(sizes=64), "`sizes=64` is no setting of the simulator, allowed: angles="),
        (lambda p, c: ss.evaluate(np.ones((2, 16, 16)), np.ones((2, 16, 16))), r"shape \[2, 16, 16\], allowed: \[3 or 4"),
        (lambda p, c: ss.read("nowhere.npy"), "nowhere.npy: no such file"),
    ],
)
def test_what_cannot_be_is_named(capture, call, message):
    pipeline = ss.Pipeline(capture.device, iterations=2)
    with pytest.raises(ss.Error, match=message) as caught:
        call(pipeline, capture)
    assert isinstance(caught.value, ValueError)


def test_single_nans_are_ignored_and_warned_of(capture):
    raw = (capture.raw.astype(np.float32) - 1024) / 64511
    raw[5, 7] = np.nan
    r = ss.Pipeline(capture.device, iterations=4)(raw, capture.guide)
    assert any("NaN" in warning for warning in r.warnings) and not r.valid[5, 7] and np.isfinite(r.stokes).all()


def test_averaged_counts_are_counts_where_that_is_said(capture):
    solve = ss.Pipeline(capture.device, iterations=4)
    counts = solve(capture.raw, capture.guide).stokes
    assert np.array_equal(solve(capture.raw.astype(float), capture.guide, unit="counts").stokes, counts)


def test_results_outlive_the_pipeline_and_later_frames(capture):
    solve = ss.Pipeline(capture.device, iterations=4)
    first = solve(capture.raw, capture.guide)
    kept = [a.copy() for a in (first.stokes, first.angles, first.valid)]
    solve(capture.raw[::-1], capture.guide[::-1])
    del solve
    gc.collect()
    np.ones((2048, 2048)).sum()
    assert all(np.array_equal(a, b) for a, b in zip(kept, (first.stokes, first.angles, first.valid)))
    first.stokes[:] = 0  # they are the user's own


def test_inputs_are_left_as_they_are(capture):
    raw, guide = capture.raw.copy(), capture.guide.copy()
    raw.flags.writeable = guide.flags.writeable = False
    ss.Pipeline(capture.device, iterations=2)(raw, guide)
    assert np.array_equal(raw, capture.raw) and np.array_equal(guide, capture.guide)


def test_two_threads_solve_two_devices_at_once(capture):
    other = ss.simulate("spheres", size=48, stripes=8, surround=0, guide_margin=0)
    captures = [capture, other]
    expected = [ss.Pipeline(c.device, iterations=10, threads=1)(c.raw, c.guide).stokes for c in captures]
    found = [None, None]
    solvers = [ss.Pipeline(c.device, iterations=10, threads=1) for c in captures]
    barrier = threading.Barrier(2)

    def work(k):
        barrier.wait()
        found[k] = [solvers[k](captures[k].raw, captures[k].guide).stokes for _ in range(5)]

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert all(np.array_equal(stokes, expected[k]) for k in range(2) for stokes in found[k])


def test_one_pipeline_serves_several_threads(capture):
    solve, found = ss.Pipeline(capture.device, iterations=5), []
    threads = [threading.Thread(target=lambda: found.append(solve(capture.raw, capture.guide).stokes)) for _ in range(4)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert len(found) == 4 and all(np.array_equal(found[0], f) for f in found)


def test_python_goes_on_while_a_frame_is_solved():
    capture = ss.simulate("wedges", size=250, surround=0, guide_margin=0)
    solve = ss.Pipeline(capture.device, iterations=300, threads=1)
    ticks, done = [], threading.Event()

    def work():
        solve(capture.raw, capture.guide)
        done.set()

    thread = threading.Thread(target=work)
    start = time.perf_counter()
    thread.start()
    while not done.is_set():
        ticks.append(time.perf_counter())
        time.sleep(0.002)
    thread.join()
    gaps = np.diff([start, *ticks, time.perf_counter()])
    # with the lock held there would be one gap as long as the solve
    assert len(ticks) > 10 and gaps.max() < 0.5 * gaps.sum()


def test_importing_brings_no_server_and_starts_nothing():
    code = "import threading, stokescope, stokescope._native as n; print(threading.active_count(), n.__file__)"
    count, path = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    content = open(path, "rb").read()
    assert count == "1" and not [word for word in (b"hyper", b"axum", b"tokio", b"clap_builder") if word in content]


def test_there_is_a_stub_for_everything_compiled():
    import ast
    from pathlib import Path

    stub = ast.parse((Path(ss.__file__).parent / "_native.pyi").read_text())
    for node in stub.body:
        if isinstance(node, ast.ClassDef) and node.name != "Solved":
            there = getattr(ss._native, node.name)
            names = {n.name for n in node.body if isinstance(n, ast.FunctionDef)}
            public = {n for n in vars(there) if not n.startswith("_") or n == "__init__" and "__init__" in names}
            assert names <= public | {"__init__"} and public - {"__init__"} <= names, node.name
    assert (Path(ss.__file__).parent / "py.typed").exists()
