"""Sessions solved again on a cluster."""

from __future__ import annotations

import json
import os
import threading
from pathlib import Path
from typing import Any, Dict, Iterable, List, Tuple, Union

import numpy as np

from . import _native
from ._batch import write_whole
from ._pipeline import Pipeline
from ._session import Session

_planned = threading.local()
"""The session, pipeline and array of this thread of a worker, and what they were made for."""


def reprocess(
    session: Union[Session, str, os.PathLike], client: Any = None, *, out: Union[str, os.PathLike], block: int = 8, threads: int = 1,
    **settings: Any,
) -> Dict[str, int]:
    """Solves every frame of a recorded session again, on any Dask cluster, into one OME-Zarr array.

    A frame is a chunk, which appears whole or not at all. A run that was interrupted goes on with the frames that are missing, and a run
    over a complete array does nothing. Frames do not depend on each other, so that the array has the same bits on one process and on many
    workers, some of which may die.

    Parameters
    ----------
    session : Session or path
        The recording, in a folder that all workers see under this name.
    client : dask.distributed.Client, optional
        The cluster; this process alone unless given. Every worker needs this package.
    out : path
        Folder of the array, ``x.ome.zarr``, which all workers see under this name. Reports are in ``reports/`` beside its chunks.
    block : int
        Frames of one task.
    threads : int
        Threads of the solver in each thread of a worker. Their number changes results by rounding.
    **settings
        Others of :class:`Pipeline`; iterations and alignment are those of the recording unless given.

    Returns
    -------
    dict
        ``frames`` of the session, those ``solved`` now and those ``kept``.

    Raises
    ------
    Error
        After all other frames are solved: those that could not be, and why. Before anything is solved: a session without frames, or a
        folder with other contents.
    """
    if settings.pop("video", False):
        raise _native.Error("video = True, allowed: False: the frames of a cluster do not follow each other")
    if block < 1:
        raise _native.Error(f"block = {block}, allowed: 1 or more")
    opened = session if isinstance(session, Session) else Session(session)
    if not len(opened):
        raise _native.Error(f"{opened.path}: 0 complete frames, allowed: 1 or more")
    recorded = {key: opened.description[key] for key in ("iterations", "register")}
    task = (str(opened.path.resolve()), str(Path(out).resolve()), json.dumps({**recorded, "threads": threads, **settings}, sort_keys=True))
    array = _array(opened, *task[1:])
    (Path(out) / "reports").mkdir(exist_ok=True)
    missing = [index for index in range(len(opened)) if not array.has(index)]
    blocks = [missing[start:start + block] for start in range(0, len(missing), block)]
    failed = [line for found in _run(client, task, blocks) for line in found]
    if failed:
        raise _native.Error(f"{len(missing) - len(failed)} frames solved; not solved:\n" + "\n".join(failed))
    return {"frames": len(opened), "solved": len(missing), "kept": len(opened) - len(missing)}


def _run(client: Any, task: Tuple[str, str, str], blocks: List[List[int]]) -> Iterable[List[str]]:
    if client is None:
        return (_solve(task, block) for block in blocks)
    from dask.distributed import as_completed

    # results are on the disk: a task that is run twice writes the same bytes again
    futures = client.map(_solve, [task] * len(blocks), blocks, pure=False)
    return (found for _, found in as_completed(futures, with_results=True))


def _array(session: Session, out: str, settings: str) -> _native.Zarr:
    device, seconds = session.device, np.array([frame.seconds for frame in session])
    steps = np.diff(seconds)
    origin = {"session": session.path.name, "bundle": device._native.digest, "settings": json.loads(settings)}
    return _native.Zarr(
        out, device.channels, bool(device.angles), device.size, [frame.name for frame in session],
        float(np.median(steps)) if len(steps) else None, json.dumps(origin),
    )


def _plan(task: Tuple[str, str, str]) -> Tuple[Session, Pipeline, _native.Zarr]:
    """Session, pipeline and array of a task, made once in a thread of a worker."""
    if getattr(_planned, "task", None) != task:
        path, out, settings = task
        session = Session(path)
        guided = bool(session.description.get("guide", True))
        _planned.made = session, Pipeline(session.device, **{"guided": guided, **json.loads(settings)}), _array(session, out, settings)
        _planned.task = task
    return _planned.made


def _solve(task: Tuple[str, str, str], block: List[int]) -> List[str]:
    """Solves frames; returns a line for each that cannot be used."""
    session, solve, array = _plan(task)
    failed = []
    for index in block:
        frame = session[index]
        try:
            result = solve(frame.raw, frame.guide)
        except _native.Error as e:
            failed.append(f"frame {frame.name}: {e}")
            continue
        report = json.dumps(result.report, indent=1).encode()
        write_whole(Path(task[1]) / "reports" / f"{frame.name}.json", lambda file: file.write(report))
        # the chunk comes last: a frame that has one is done
        array.write(index, result.stokes.reshape(-1, *result.stokes.shape[-2:]), result.valid)
    return failed
