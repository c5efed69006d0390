"""Results are those of the command line, bit for bit."""

import json
import re

import numpy as np
import pytest

import stokescope as ss
from conftest import ROOT


def both(command, bundle, tmp_path, raw, guide, **settings):
    args = ["--json", "reconstruct", "--calibration", bundle, "--raw", raw, "--out", tmp_path / "out", "--threads", "2"]
    args += ["--guide", guide] if guide else []
    args += [word for key, value in settings.items() for word in (f"--{key}", value)]
    said = json.loads(command(*args))
    solve = ss.Pipeline(ss.Device.load(bundle), guided=guide is not None, threads=2, **settings)
    result = solve(ss.read(raw), None if guide is None else ss.read(guide))
    return said, result, {name: np.load(tmp_path / "out" / f"{name}.npy") for name in ("stokes", "stokes_error", "angles")}


@pytest.mark.parametrize("settings", [{}, {"iterations": 7}, {"method": "admm", "iterations": 3}, {"fusion": "preview"}], ids=str)
@pytest.mark.parametrize("guided", [True, False])
def test_a_frame_is_that_of_the_command(command, bundle, tmp_path, guided, settings):
    said, result, files = both(command, bundle, tmp_path, bundle / "raw.npy", bundle / "guide.npy" if guided else None, **settings)
    assert np.array_equal(result.stokes, files["stokes"]) and np.array_equal(result.angles, files["angles"])
    assert np.array_equal(result.errors, files["stokes_error"]) and result.errors.shape == result.stokes.shape
    assert result.warnings == said["warnings"] and result.report["calibration"] == said["calibration"]
    for key in ("method", "iterations", "residual_rms", "gain", "mean_dolp", "modelled", "model"):
        assert result.report[key] == said[key], key


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "float64"])
def test_every_number_format_is_that_of_the_command(command, bundle, capture, tmp_path, dtype):
    raw = capture.raw.astype(np.float64)
    raw = (raw / 256).astype(dtype) if dtype == "uint8" else raw.astype(dtype) if dtype == "uint16" else ((raw - 1024) / 64511).astype(dtype)
    guide = (capture.guide * 250).astype(np.uint8)
    np.save(tmp_path / "raw.npy", raw)
    np.save(tmp_path / "guide.npy", guide)
    if dtype == "uint8":
        text = (bundle / "calibration.toml").read_text()
        for of_16_bits, of_8_bits in [("bit_depth = 16", "bit_depth = 8"), ("black_level = 1024", "black_level = 4"), ("= 65535", "= 255")]:
            assert text.count(of_16_bits) == 1
            text = text.replace(of_16_bits, of_8_bits)
        (tmp_path / "calibration.toml").write_text(text)
        (tmp_path / "psf.npy").write_bytes((bundle / "psf.npy").read_bytes())
        bundle = tmp_path
    _, result, files = both(command, bundle, tmp_path, tmp_path / "raw.npy", tmp_path / "guide.npy", iterations=4)
    assert np.array_equal(result.stokes, files["stokes"])
    wider = {"uint8": "int32", "uint16": "int64"}.get(dtype, ">f8" if dtype == "float64" else "float32")
    solve = ss.Pipeline(ss.Device.load(bundle), iterations=4, threads=2)
    assert np.array_equal(solve(raw.astype(wider), guide[:, ::-1][:, ::-1].tolist()).stokes, result.stokes)


def test_colours_last_or_first_are_the_same_as_the_command(command, tmp_path):
    capture = ss.simulate("spheres", size=(48, 40), color="rgb", stripes=8)
    capture.save(tmp_path)
    _, result, files = both(command, tmp_path, tmp_path, tmp_path / "raw.npy", tmp_path / "guide.npy", iterations=3)
    assert result.stokes.shape == (3, 3, 40, 48) and np.array_equal(result.stokes, files["stokes"])
    last = ss.Pipeline(capture.device, iterations=3, threads=2)(np.moveaxis(capture.raw, 0, 2), np.moveaxis(capture.guide, 0, 2))
    assert np.array_equal(last.stokes, result.stokes)
    s, e = result.stokes.sum(0), np.sqrt(np.square(result.errors).sum(0))
    assert np.allclose(result.dolp, np.hypot(s[1], s[2]) / s[0]) and result.s0.shape == (3, 40, 48)
    length = np.hypot(s[1], s[2])
    error = np.hypot(s[1] * e[1], s[2] * e[2]) / length
    assert np.allclose(result.dolp_error, np.hypot(error, length / s[0] * e[0]) / s[0], rtol=1e-4)
    assert np.array_equal(np.isnan(result.aolp_error), length <= error) and 0 < np.isnan(result.aolp_error).mean() < 1


def test_a_mosaic_is_that_of_the_command(command, bundle, capture, tmp_path):
    """Polarizers on the pixels: from a bundle, and from arrays."""
    text, mask = (bundle / "calibration.toml").read_text().split("[mask]\n")
    assert mask.count("\n") == 3, "the mask is the last section"
    (tmp_path / "calibration.toml").write_text(text + '[mask]\nkind = "mosaic"\nlayout = [[90, 45], [135, 0]]\n')
    (tmp_path / "psf.npy").write_bytes((bundle / "psf.npy").read_bytes())
    # each pixel reads the blurred image behind its own polarizer, in the order 0, 45, 90, 135 degrees
    psf = np.load(bundle / "psf.npy").astype(float)
    spectrum = np.fft.rfft2(psf / psf.sum(), (128, 128))
    blurred = np.fft.irfft2(np.fft.rfft2(capture.truth, (128, 128)) * spectrum)[:, 32:96, 32:96]
    light = np.take_along_axis(blurred, np.tile([[2, 1], [3, 0]], (32, 32))[None], 0)[0]
    raw = (1024 + 64511 * light).round().clip(0, 65535).astype(np.uint16)
    np.save(tmp_path / "raw.npy", raw)
    for guide in (None, bundle / "guide.npy"):
        _, result, files = both(command, tmp_path, tmp_path, tmp_path / "raw.npy", guide, iterations=5)
        assert np.array_equal(result.stokes, files["stokes"]) and np.array_equal(result.angles, files["angles"])
        device = ss.Device(np.load(bundle / "psf.npy"), ss.mosaic(), black_level=1024, noise=(0.001, 1e-6))
        solve = ss.Pipeline(device, guided=guide is not None, iterations=5, threads=2)
        assert np.array_equal(solve(raw, None if guide is None else ss.read(guide)).stokes, result.stokes)
    striped = ss.Pipeline(ss.Device.load(bundle), guided=False, iterations=5, threads=2)(raw)
    assert not np.array_equal(striped.stokes, result.stokes)


def test_a_simulation_is_that_of_the_command(command, tmp_path):
    command("simulate", "--out", tmp_path / "a", "--scene", "tissue", "--size", "40x32", "--noise", "0.003", "--seed", "5", "--angles", "3")
    ss.simulate("tissue", size=(40, 32), noise=0.003, seed=5, angles=3).save(tmp_path / "b")
    for name in ("raw", "guide", "truth", "psf"):
        assert np.array_equal(np.load(tmp_path / "a" / f"{name}.npy"), np.load(tmp_path / "b" / f"{name}.npy")), name
    assert (tmp_path / "a/calibration.toml").read_text() == (tmp_path / "b/calibration.toml").read_text()


def test_scores_are_those_of_the_command(command, bundle, capture, tmp_path):
    result = ss.Pipeline(capture.device, iterations=5)(capture.raw, capture.guide)
    np.save(tmp_path / "angles.npy", result.angles)
    said = json.loads(command("--json", "evaluate", tmp_path / "angles.npy", bundle / "truth.npy"))
    assert ss.evaluate(result, capture.truth) == said and said["psnr"] > 25


def test_a_session_gives_back_what_was_recorded(command, tmp_path):
    for form in ("npy", "ome-tiff", "png16"):
        command("run", "--board", "x86-sim", "--no-preview", "--frames", "3", "--out", tmp_path / "out", "--record", tmp_path / form,
                "--record-format", form)
        session = ss.Session(tmp_path / form)
        assert len(session) == 3 and session.device.size == (250, 250) and [frame.seconds for frame in session][0] < session[2].seconds
        frame = session[-1]
        assert frame.raw.dtype == np.uint16 and frame.raw.shape == (250, 250) and frame.guide.ndim == 2
        result = ss.Pipeline(session.device, iterations=4)(frame.raw, frame.guide)
        # the recorded result comes of more iterations and of the frames before
        assert abs(result.report["mean_dolp"] - frame.report["mean_dolp"]) < 0.1
    sidecar = next((session.path / "frames").glob("*.json"))
    text = json.loads(sidecar.read_text())
    sidecar.write_text(json.dumps({**text, "files": ["../../secret.npy"]}))
    with pytest.raises(ss.Error, match="allowed: paths inside the session"):
        ss.Session(session.path)
    with pytest.raises(ss.Error, match="no session: give a folder"):
        ss.Session(tmp_path / "out")


def test_the_quickstart_of_the_readme_runs(tmp_path, monkeypatch):
    section = (ROOT / "README.md").read_text().split("## Python")[1].split("\n## ")[0]
    blocks = re.findall(r"```python\n(.*?)```", section, re.S)
    assert blocks
    monkeypatch.chdir(tmp_path)
    names = {}
    for block in blocks:
        exec(block, names)
    assert names["r"].stokes.shape == (3, 250, 250)
