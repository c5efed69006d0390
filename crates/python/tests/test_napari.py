"""The plugin of napari: layers of sessions, results and arrays; in a window where there is napari."""

import json
import socket
import subprocess
import time

import numpy as np
import pytest

import stokescope as ss
from stokescope import napari as plugin

pytest.importorskip("dask")


def test_layers_are_those_of_the_files(command, session, bundle, tmp_path):
    read = plugin.get_reader(str(session.path))(str(session.path))
    names = [look["name"] for _, look, _ in read]
    assert names == ["raw", "guide", "S0", "DoLP", "AoLP"] and all(len(image) == len(session) for image, _, _ in read)
    assert all(image.shape[1:] == (250, 250) for image, look, _ in read if look["name"] != "guide")
    images = dict(zip(names, (image[5].compute() for image, _, _ in read)))
    assert np.array_equal(images["DoLP"], session[5].result.dolp) and np.array_equal(images["raw"], session[5].raw)
    out = tmp_path / "x.ome.zarr"
    command("export", session.path, "--format", "ome-zarr", "--out", out)
    read = {look["name"]: image for image, look, _ in plugin.get_reader(str(out))(str(out))}
    assert np.allclose(read["DoLP"][5].compute(), images["DoLP"], atol=1e-6)
    command("reconstruct", "--calibration", bundle, "--raw", bundle / "raw.npy", "--out", tmp_path / "r", "--iterations", "2", "--force")
    report = str(tmp_path / "r/report.json")
    assert [look["name"] for _, look, _ in plugin.get_reader(report)(report)] == ["S0", "DoLP", "AoLP"]
    assert plugin.get_reader(str(tmp_path)) is None and plugin.get_reader([report]) is None


@pytest.fixture
def service(command, tmp_path):
    """A running service with simulated cameras; gives its address."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    out = tmp_path / "live"
    running = subprocess.Popen(
        [command("--path"), "run", "--board", "x86-sim", "--iterations", "3", "--out", out, "--listen", f"127.0.0.1:{port}"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    yield f"http://127.0.0.1:{port}"
    running.terminate()
    running.wait(30)


def first(url):
    for _ in range(300):
        try:
            return ss.Live(url).latest()
        except ss.Error:
            time.sleep(0.1)
    raise AssertionError("no result in 30 s")


def test_live_results_come_each_once(service):
    frame = first(service)
    assert frame.stokes.shape == (3, 250, 250) and frame.dolp.shape == (250, 250) and frame.age < 30
    frames = [frame for frame, _ in zip(ss.Live(service, interval=0.02), range(4))]
    assert all(a.number < b.number for a, b in zip(frames, frames[1:]))
    with pytest.raises(ss.Error, match="http://127.0.0.1:1/frame.*refused"):
        ss.Live("http://127.0.0.1:1").latest()


def test_napari_shows_a_session_and_the_live_service(session, service, monkeypatch):
    pytest.importorskip("qtpy")
    pytest.importorskip("napari")
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    from napari.components import ViewerModel
    from qtpy.QtWidgets import QApplication

    pytest.importorskip("npe2").PluginManager.instance().discover()
    application = QApplication.instance() or QApplication([])
    first(service)
    viewer = ViewerModel()
    viewer.open(str(session.path), plugin="stokescope")
    assert [layer.name for layer in viewer.layers] == ["raw", "guide", "S0", "DoLP", "AoLP"]
    assert viewer.dims.nsteps[0] == len(session) and viewer.layers["AoLP"].colormap.name == "hsv"
    assert np.allclose(viewer.layers["AoLP"].data[5].compute(), session[5].result.aolp)
    worker = plugin.live(viewer, service)
    for _ in range(300):
        application.processEvents()
        if "live AoLP" in viewer.layers:
            break
        time.sleep(0.1)
    worker.quit()
    assert viewer.layers["live DoLP"].data.shape == (250, 250)
    worker.await_workers(20_000)


def test_the_manifest_is_right():
    npe2 = pytest.importorskip("npe2")
    manifest = npe2.PluginManifest.from_distribution("stokescope")
    manifest.validate_imports()
    assert json.loads(manifest.json())["contributions"]["readers"][0]["accepts_directories"]
