"""Folders of frames."""

from __future__ import annotations

import json
import os
import re
import threading
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Tuple, Union

import numpy as np

from . import _native
from ._device import Device
from ._pipeline import Pipeline
from ._session import read

ENDINGS = {".npy", ".png", ".tif", ".tiff"}
Folder = Union[str, os.PathLike]


def reconstruct_folder(device: Union[Device, Folder], raw: Folder, guide: Optional[Folder], out: Folder, **settings: Any) -> Dict[str, Dict[str, Any]]:
    """Solves every frame of a folder, each beside the guide of the same name or number.

    The result of ``frame_7.tif`` is ``out/frame_7.npy``, its Stokes images, with its report in ``out/frame_7.json``. It is bit for bit that
    of the frame alone. A frame that cannot be used does not stop the rest.

    Parameters
    ----------
    device : Device or path
        The camera, or the folder of its bundle.
    raw, guide : path
        Folders of NPY, PNG and TIFF files, one frame each; None for `guide` solves without guides. Names are paired where they are equal but
        for leading zeros of numbers, otherwise by their last number.
    out : path
        Folder of the results, created where there is none; not one of the others.
    **settings
        Those of :class:`Pipeline`.

    Returns
    -------
    dict of str to dict
        The report of each frame by its name, in the order that people count.

    Raises
    ------
    Error
        After all other frames are solved: the frames that could not be used, and why. Before anything is written: folders without frames,
        or whose names cannot be paired.
    """
    raws, target = _files(Path(raw)), Path(out)
    guides = None if guide is None else _files(Path(guide))
    if any(target.resolve() == Path(folder).resolve() for folder in (raw, guide) if folder is not None):
        raise _native.Error(f"out = {str(target)!r}: holds the frames, whose names the results have; give another folder")
    pairs, failed = ([(path, None) for path in raws], []) if guides is None else _paired(raws, guides)
    solve = Pipeline(device if isinstance(device, Device) else Device.load(device), guided=guides is not None, **settings)
    target.mkdir(parents=True, exist_ok=True)
    reports = {}
    for path, beside in pairs:
        try:
            result = solve(read(path), None if beside is None else read(beside))
        except _native.Error as e:
            failed.append(f"{path}: {e}")
            continue
        write_whole(target / f"{path.stem}.npy", lambda file: np.save(file, result.stokes))
        write_whole(target / f"{path.stem}.json", lambda file: file.write(json.dumps(result.report, indent=1).encode()))
        reports[path.stem] = result.report
    if failed:
        raise _native.Error(f"{len(reports)} frames solved; not solved:\n" + "\n".join(failed))
    return reports


def _files(folder: Path) -> List[Path]:
    """The frames of a folder in the order that people count, without hidden files."""
    if not folder.is_dir():
        raise _native.Error(f"{folder}: no such folder")
    found = [path for path in folder.iterdir() if path.suffix.lower() in ENDINGS and not path.name.startswith(".") and path.is_file()]
    if not found:
        raise _native.Error(f"{folder}: 0 frames, allowed: 1 or more, NPY, PNG or TIFF")
    stems: Dict[str, Path] = {}
    for path in found:
        if path.stem in stems:
            raise _native.Error(f"{stems[path.stem]} and {path} have one name: results are named after it")
        stems[path.stem] = path
    return sorted(found, key=lambda path: [(int(part), "") if _counts(part) else (-1, part) for part in _parts(path.stem)])


def _parts(name: str) -> List[str]:
    return [part for part in re.split("([0-9]+)", name) if part]


def _counts(part: str) -> bool:
    return part[0] in "0123456789"


def _name(path: Path) -> str:
    """The name, in which leading zeros of numbers do not count."""
    return "".join(part.lstrip("0") or "0" if _counts(part) else part for part in _parts(path.stem))


def _number(path: Path) -> Optional[str]:
    """The last number in the name."""
    numbers = [part for part in _parts(path.stem) if _counts(part)]
    return (numbers[-1].lstrip("0") or "0") if numbers else None


def _paired(raws: List[Path], guides: List[Path]) -> Tuple[List[Tuple[Path, Optional[Path]]], List[str]]:
    """Each raw frame with its guide, and what has no partner."""
    keys: Tuple[Callable[[Path], Optional[str]], ...] = (_name, _number)
    for key in keys:
        of_raws, of_guides = [{key(path): path for path in paths} for paths in (raws, guides)]
        unique = None not in {*of_raws, *of_guides} and (len(of_raws), len(of_guides)) == (len(raws), len(guides))
        if unique and of_raws.keys() & of_guides.keys():
            alone = [f"{path}: no guide of this name or number" for k, path in of_raws.items() if k not in of_guides]
            alone += [f"{path}: no raw frame of this name or number" for k, path in of_guides.items() if k not in of_raws]
            return [(path, of_guides[k]) for k, path in of_raws.items() if k in of_guides], alone
    raise _native.Error(f"{raws[0].parent} and {guides[0].parent}: no raw frame has the name or the number of a guide; name both alike")


def write_whole(path: Path, fill: Callable[[Any], Any]) -> None:
    """Writes a file that is complete under its name or not there."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        with open(part, "wb") as file:
            fill(file)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
