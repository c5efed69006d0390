"""A folder of frames: every frame once, beside its own guide, and what is wrong by name."""

import json

import numpy as np
import pytest

import stokescope as ss


@pytest.fixture
def folders(bundle, tmp_path):
    """Frames 8 to 11, whose guides have padded numbers."""
    simulation = ss.simulate("wedges", size=64, noise=0.001, surround=0, guide_margin=0)
    (tmp_path / "r").mkdir()
    (tmp_path / "g").mkdir()
    for k in (8, 9, 10, 11):
        np.save(tmp_path / f"r/frame_{k}.npy", np.roll(simulation.raw, k % 2, 0))
        np.save(tmp_path / f"g/frame_{k:03}.npy", np.roll(simulation.guide, k % 2, 0))
    (tmp_path / "r/._frame_8.npy").write_text("not an image")
    return tmp_path


def test_every_frame_is_that_of_the_frame_alone(bundle, folders):
    reports = ss.reconstruct_folder(bundle, folders / "r", folders / "g", folders / "out", iterations=4, threads=2)
    assert list(reports) == ["frame_8", "frame_9", "frame_10", "frame_11"]
    for k, name in enumerate(reports, 8):
        solve = ss.Pipeline(ss.Device.load(bundle), iterations=4, threads=2)
        alone = solve(np.load(folders / f"r/{name}.npy"), np.load(folders / f"g/frame_{k:03}.npy"))
        assert np.array_equal(np.load(folders / f"out/{name}.npy"), alone.stokes), name
        assert json.loads((folders / f"out/{name}.json").read_text())["residual_rms"] == alone.report["residual_rms"]
    assert sorted(path.suffix for path in (folders / "out").iterdir()) == [".json"] * 4 + [".npy"] * 4


def test_bad_frames_are_named_and_the_rest_is_solved(bundle, folders):
    (folders / "r/frame_9.npy").write_text("not an image")
    (folders / "g/frame_010.npy").unlink()
    with pytest.raises(ss.Error) as caught:
        ss.reconstruct_folder(bundle, folders / "r", folders / "g", folders / "out", iterations=2)
    for part in ("2 frames solved", "r/frame_10.npy: no guide of this name or number", "frame_9.npy: file type is"):
        assert part in str(caught.value), caught.value
    assert sorted(path.name for path in (folders / "out").glob("*.npy")) == ["frame_11.npy", "frame_8.npy"]


def test_what_cannot_be_paired_is_refused_before_anything_is_written(bundle, folders):
    run = lambda **other: ss.reconstruct_folder(**{"device": bundle, "raw": folders / "r", "guide": folders / "g", "out": folders / "out", **other})
    (folders / "x").mkdir()
    for other, message in [
        ({"out": folders / "r"}, "holds the frames"),
        ({"guide": folders / "x"}, "0 frames, allowed: 1 or more"),
        ({"raw": folders / "y"}, "no such folder"),
    ]:
        with pytest.raises(ss.Error, match=message):
            run(**other)
    np.save(folders / "x/other.npy", np.zeros((64, 64)))
    with pytest.raises(ss.Error, match="no raw frame has the name or the number of a guide"):
        run(guide=folders / "x")
    np.save(folders / "r/frame_8.tif", np.zeros((64, 64)))
    (folders / "r/frame_8.tif.npy").rename(folders / "r/frame_8.tif")
    with pytest.raises(ss.Error, match="have one name"):
        run()
    assert not (folders / "out").exists()
