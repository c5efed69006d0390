"""Recordings of the live service, and image files."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional, Union

import numpy as np

from . import _native
from ._device import Device
from ._pipeline import Polarization

VERSION = 1


def read(path: Union[str, os.PathLike]) -> np.ndarray:
    """An image file as an array: [H, W], or [3, H, W] for colours.

    Integers are counts, floating-point values are as stored. The formats are those that the command line reads.
    """
    return _native.read_image(os.fspath(path))


class Frame:
    """One recorded frame; its images are read when they are asked for.

    Attributes
    ----------
    report : dict
        Figures of the result that was recorded.
    seconds : float
        Time on the clock of the raw camera.
    """

    def __init__(self, session: Path, sidecar: Dict[str, Any], channels: int) -> None:
        self._session, self._files, self._channels = session, [str(file) for file in sidecar["files"]], channels
        self.seconds: float = sidecar["raw_seconds"]
        self.report: Dict[str, Any] = sidecar.get("report", {})

    def _read(self, kind: str) -> Optional[np.ndarray]:
        inside = [file for file in self._files if Path(file).parent == Path(kind)]
        return read(self._session / inside[0]) if inside else None

    @property
    def raw(self) -> np.ndarray:
        """Readings of the lensless sensor, [H, W] or [3, H, W]: counts, or fractions of full scale."""
        raw = self._read("raw")
        if raw is None:
            raise _native.Error(f"{self._session}: a frame has no file in raw/")
        return raw

    @property
    def guide(self) -> Optional[np.ndarray]:
        """Frame of the guide camera, [H, W] or [3, H, W]; None where the frame has none."""
        return self._read("guide")

    @property
    def result(self) -> Optional[Polarization]:
        """The result that was recorded; None in a session of the format png16, which keeps pictures alone."""
        stokes = self._read("stokes")
        if stokes is None:
            return None
        height, width = stokes.shape[-2:]
        shape = (self._channels, -1, height, width) if self._channels > 1 else (-1, height, width)
        return Polarization(stokes.reshape(shape))

    @property
    def name(self) -> str:
        """Name of the frame's files, without folder and ending."""
        return Path(self._files[0]).name.split(".")[0]


class Session:
    """A recorded session: a sequence of complete :class:`Frame` objects in the order they were taken.

    Parameters
    ----------
    path : str or path
        A folder with ``session.json``, or a folder of sessions, of which the newest is taken.

    Attributes
    ----------
    path : Path
        The folder of the session.
    description : dict
        How it was recorded.
    """

    def __init__(self, path: Union[str, os.PathLike]) -> None:
        folder = Path(path)
        if not (folder / "session.json").is_file():
            found = sorted(d for d in folder.glob("session-*") if (d / "session.json").is_file())
            if not found:
                raise _native.Error(f"{folder}: no session: give a folder with session.json, or one of such folders")
            folder = found[-1]
        self.path = folder
        self.description: Dict[str, Any] = _json(folder / "session.json")
        if self.description.get("version") != VERSION:
            raise _native.Error(f"{folder / 'session.json'}: version = {self.description.get('version')}, allowed: {VERSION}")
        self._frames: List[Dict[str, Any]] = []
        for path in sorted((folder / "frames").glob("*.json")):
            if path.name.startswith("."):
                continue
            frame = _sidecar(path)
            # a camera that was opened again starts its clock anew: only frames of increasing times are one recording
            if not self._frames or self._frames[-1]["raw_seconds"] < frame["raw_seconds"]:
                self._frames.append(frame)

    @property
    def device(self) -> Device:
        """The device that the session was recorded with."""
        return Device.load(self.path / "calibration")

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return Frame(self.path, self._frames[index], self.description.get("channels", 1))

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def __repr__(self) -> str:
        return f"Session({str(self.path)!r}, {len(self)} frames)"


def _json(path: Path) -> Dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise _native.Error(f"{path}: {e}") from e


def _sidecar(path: Path) -> Dict[str, Any]:
    """A sidecar whose files lie inside its session."""
    frame = _json(path)
    missing = {"raw_seconds", "files"} - frame.keys()
    if missing:
        raise _native.Error(f"{path}: {', '.join(sorted(missing))} missing")
    for file in map(Path, frame["files"]):
        if file.is_absolute() or ".." in file.parts:
            raise _native.Error(f"{path}: files: {str(file)!r}, allowed: paths inside the session")
    return frame
