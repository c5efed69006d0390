"""Sessions on a cluster: the array is complete and has the same bits, whatever dies; other programs read it."""

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import stokescope as ss

distributed = pytest.importorskip("distributed")
zarr = pytest.importorskip("zarr")


@pytest.fixture(scope="module")
def one_process(session, tmp_path_factory):
    """The session solved by this process alone."""
    out = tmp_path_factory.mktemp("one") / "x.ome.zarr"
    assert ss.reprocess(session, out=out, iterations=15) == {"frames": 8, "solved": 8, "kept": 0}
    return out


def test_a_killed_worker_costs_no_bit_and_a_second_run_does_nothing(session, one_process, tmp_path):
    out = tmp_path / "x.ome.zarr"
    chunks = lambda: sorted((out / "0/c").glob("*/0/0/0"))
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
        with distributed.Client(cluster) as client:
            pids, killed = list(client.run(os.getpid).values()), []

            def kill():
                while not chunks():
                    time.sleep(0.005)
                os.kill(pids[0], signal.SIGKILL)
                killed.append(len(chunks()))

            thread = threading.Thread(target=kill)
            thread.start()
            done = ss.reprocess(session, client, out=out, iterations=15, block=1)
            thread.join()
            assert done == {"frames": 8, "solved": 8, "kept": 0} and killed[0] < 8, killed
            expected, found = (zarr.open_group(str(path), mode="r")["0"][:] for path in (one_process, out))
            assert np.array_equal(found, expected) and len(chunks()) == 8
            stamps = [path.stat().st_mtime_ns for path in chunks()]
            assert ss.reprocess(session, client, out=out, iterations=15) == {"frames": 8, "solved": 0, "kept": 8}
            assert [path.stat().st_mtime_ns for path in chunks()] == stamps
    assert len(list((out / "reports").glob("*.json"))) == 8
    chunks()[5].unlink()
    chunks()[5].write_bytes(b"cut short")
    assert ss.reprocess(session, out=out, iterations=15) == {"frames": 8, "solved": 2, "kept": 6}
    assert np.array_equal(zarr.open_group(str(out), mode="r")["0"][:], expected)


def test_an_array_is_that_of_the_frames_and_is_read_by_others(session, one_process):
    import dask.array as da
    from ome_zarr.io import parse_url
    from ome_zarr.reader import Reader

    images = da.from_zarr(str(one_process), component="0")
    assert images.shape == (8, 6, 250, 250) and images.chunksize == (1, 6, 250, 250)
    frame = session[4]
    alone = ss.Pipeline(session.device, iterations=15, threads=1, register=session.description["register"])(frame.raw, frame.guide)
    found = images[4].compute()
    assert np.array_equal(found[:3], alone.stokes) and np.array_equal(found[5], alone.valid)
    assert np.allclose(found[3], alone.dolp, atol=1e-6) and found[4].max() < 180
    node = next(iter(Reader(parse_url(str(one_process)))()))
    assert node.data[0].shape == (8, 6, 250, 250)
    assert node.metadata["channel_names"] == ["S0", "S1", "S2", "DoLP", "AoLP (degrees)", "valid"]
    assert node.metadata["contrast_limits"][4] == [0, 180] and [axis["name"] for axis in node.metadata["axes"]] == list("tcyx")


def test_what_cannot_be_is_refused(session, one_process, tmp_path):
    for options, message in [
        ({"iterations": 7}, "holds results of other frames or settings"),
        ({"video": True}, "video = True, allowed: False"),
        ({"block": 0}, "block = 0, allowed: 1 or more"),
    ]:
        with pytest.raises(ss.Error, match=message):
            ss.reprocess(session, out=one_process, **{"iterations": 15, **options})
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ss.Error, match="holds other files"):
        ss.reprocess(session, out=tmp_path)


def test_frames_that_cannot_be_read_are_named_and_the_rest_is_solved(session, tmp_path):
    import shutil

    copy = tmp_path / "session-copy"
    shutil.copytree(session.path, copy)
    bad = sorted((copy / "raw").iterdir())[3]
    bad.write_bytes(b"not an image")
    with pytest.raises(ss.Error, match="7 frames solved; not solved:\nframe 00000003: .*file type"):
        ss.reprocess(copy, out=tmp_path / "x.zarr", iterations=2)
    shutil.copy(session.path / "raw" / bad.name, bad)
    assert ss.reprocess(copy, out=tmp_path / "x.zarr", iterations=2) == {"frames": 8, "solved": 1, "kept": 7}


def test_an_exported_session_is_the_recording(command, session, tmp_path):
    import tifffile

    recorded = np.stack([frame.result.stokes for frame in session])
    for form, name in [("ome-zarr", "x.ome.zarr"), ("ome-tiff", "x.ome.tif")]:
        command("export", session.path, "--format", form, "--out", tmp_path / name)
    images = zarr.open_group(str(tmp_path / "x.ome.zarr"), mode="r")["0"][:]
    assert np.array_equal(images[:, :3], recorded) and images.shape == (8, 5, 250, 250)
    with tifffile.TiffFile(tmp_path / "x.ome.tif") as tiff:
        assert tiff.is_bigtiff and tiff.is_ome and tiff.series[0].axes == "TCYX"
        assert np.array_equal(tiff.asarray(), images)
        assert "ome:" not in tiff.ome_metadata and 'Name="AoLP (degrees)"' in tiff.ome_metadata and "TimeIncrement=" in tiff.ome_metadata
        metadata = tiff.pages[0].tags["IJMetadata"].value
    assert metadata["Labels"][:5] == ["S0", "S1", "S2", "DoLP", "AoLP (degrees)"] and len(metadata["Labels"]) == 40
    assert metadata["Ranges"][-2:] == (0.0, 180.0)
    before = sorted(Path(tmp_path).iterdir())
    for name in ("x.ome.zarr", "x.ome.tif"):
        with pytest.raises(AssertionError, match="holds something already"):
            command("export", session.path, "--format", "ome-tiff", "--out", tmp_path / name)
    assert sorted(Path(tmp_path).iterdir()) == before, "nothing is left over"


def test_results_of_a_batch_open_in_imagej_with_names_and_ranges(command, bundle, tmp_path):
    import shutil

    import tifffile

    for kind in ("raw", "guide"):
        (tmp_path / kind).mkdir()
        shutil.copy(bundle / f"{kind}.npy", tmp_path / kind / "frame_1.npy")
    for form, name in [("tiff", "frame_1.tif"), ("ome-tiff", "frame_1.ome.tif")]:
        command("reconstruct", "--calibration", bundle, "--raw", tmp_path / "raw", "--guide", tmp_path / "guide", "--out", tmp_path / form,
                "--format", form, "--iterations", "3", "--force")
        with tifffile.TiffFile(tmp_path / form / name) as tiff:
            metadata = tiff.pages[0].tags["IJMetadata"].value
            assert metadata["Labels"] == ["S0", "S1", "S2", "DoLP", "AoLP (degrees)", "valid"] and metadata["Ranges"][6:10] == (0, 1, 0, 180)
            assert tiff.asarray().shape == (6, 64, 64) and tiff.is_imagej == (form == "tiff") and tiff.is_ome == (form == "ome-tiff")
