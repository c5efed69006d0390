"""The captures that all tests share, and the command line to compare with."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import stokescope as ss

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="session")
def capture():
    return ss.simulate("wedges", size=64, noise=0.001, surround=0, guide_margin=0)


@pytest.fixture(scope="session")
def bundle(capture, tmp_path_factory):
    """The capture as `stokescope simulate` writes it."""
    folder = tmp_path_factory.mktemp("bundle")
    capture.save(folder)
    return folder


@pytest.fixture(scope="session")
def command():
    """Runs the program of this repository ($STOKESCOPE, or the newest build) and returns what it printed; its path for "--path"."""
    builds = [ROOT / "target" / kind / "stokescope" for kind in ("release", "debug")]
    built = sorted((path for path in builds if path.exists()), key=lambda path: path.stat().st_mtime)
    program = os.environ.get("STOKESCOPE") or shutil.which("stokescope") or (str(built[-1]) if built else None)
    if program is None:
        pytest.skip("the program is not built: cargo build --release")

    def run(*args):
        if args == ("--path",):
            return program
        done = subprocess.run([program, *map(str, args)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture(scope="session")
def session(command, tmp_path_factory):
    """A recorded session of 8 frames of 250 × 250 pixels."""
    folder = tmp_path_factory.mktemp("recordings")
    command("run", "--board", "x86-sim", "--no-preview", "--frames", "8", "--iterations", "3", "--out", folder / "out", "--record", folder)
    return ss.Session(folder)
