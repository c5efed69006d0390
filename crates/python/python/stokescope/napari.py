"""Plugin of napari: recorded sessions and results as layers with colours for polarization, and a layer of the live service.

Sessions are read frame by frame as they are looked at. AoLP has a cyclic colour map, as 0° and 180° are one direction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Optional, Sequence, Tuple, Union

import numpy as np

from ._live import Live
from ._pipeline import Polarization
from ._session import Session

Layer = Tuple[Any, Dict[str, Any], str]

LOOKS: Dict[str, Dict[str, Any]] = {
    "S0": {"colormap": "gray"},
    "DoLP": {"colormap": "magma", "contrast_limits": (0.0, 1.0)},
    "AoLP": {"colormap": "hsv", "contrast_limits": (0.0, 180.0)},
}
"""Layers of a result; the degree and the angle of an ordinary image lie under the intensity."""


def get_reader(path: Union[str, Sequence[str]]) -> Optional[Callable[[Any], List[Layer]]]:
    """The reader of the folder of a recorded session, of ``report.json`` of ``stokescope reconstruct``, or of an array ``*.ome.zarr`` of
    this program; None for anything else."""
    if not isinstance(path, (str, Path)):
        return None
    folder = Path(path)
    if (folder / "session.json").is_file():
        return read_session
    if folder.name == "report.json" and (folder.parent / "stokes.npy").is_file():
        return read_result
    if (folder / "zarr.json").is_file() and '"stokescope"' in (folder / "zarr.json").read_text(encoding="utf-8"):
        return read_array
    return None


def layers(images: Dict[str, Any], prefix: str = "") -> List[Layer]:
    """Layers of S0, DoLP and AoLP."""
    return [
        (image, {"name": prefix + name, "visible": name == "DoLP", **LOOKS[name]}, "image") for name, image in images.items() if image is not None
    ]


def images_of(result: Polarization) -> Dict[str, Any]:
    """S0 of colours summed, DoLP and AoLP."""
    s0 = result.s0 if result.s0.ndim == 2 else result.s0.sum(0)
    return {"S0": s0, "DoLP": result.dolp, "AoLP": result.aolp}


def read_result(path: Union[str, Path]) -> List[Layer]:
    """A result of ``stokescope reconstruct``, by its folder or the report in it."""
    folder = Path(path) if Path(path).is_dir() else Path(path).parent
    return layers(images_of(Polarization(np.load(folder / "stokes.npy"))))


def read_session(path: Union[str, Path]) -> List[Layer]:
    """The recorded results of a session, with raw and guide frames, of colours their mean; each is read when it is shown."""
    import dask.array as da
    from dask import delayed

    session = Session(path)
    first = session[0]

    def lazy(of: Callable[[Any], np.ndarray]) -> Any:
        example = of(first)
        frames = [da.from_delayed(delayed(lambda k: of(session[k]))(k), example.shape, example.dtype) for k in range(len(session))]
        return da.stack(frames)

    found = []
    if first.result is not None:
        names = [name for name, image in images_of(first.result).items() if image is not None]
        found = layers({name: lazy(lambda frame, name=name: images_of(frame.result)[name]) for name in names})
    mean = lambda image: image if image.ndim == 2 else image.mean(0)
    for name in ("guide", "raw"):
        if getattr(first, name) is not None:
            image = lazy(lambda frame, name=name: mean(getattr(frame, name)))
            found.insert(0, (image, {"name": name, "colormap": "gray", "visible": False}, "image"))
    return found


def read_array(path: Union[str, Path]) -> List[Layer]:
    """An array of many frames, of ``reconstruct --format ome-zarr``, ``export`` or :func:`stokescope.reprocess`."""
    import json

    import dask.array as da

    planes = da.from_zarr(str(path), component="0")
    ome = json.loads((Path(path) / "zarr.json").read_text(encoding="utf-8"))["attributes"]["ome"]
    labels = [channel["label"] for channel in ome["omero"]["channels"]]
    of = lambda end: [planes[:, k] for k, label in enumerate(labels) if label.split(" (")[0].endswith(end)]
    images = {name: sum(of(name)) if of(name) else None for name in LOOKS}
    return layers(images)


def live(viewer: Any, url: str, token: Optional[str] = None) -> Any:
    """Shows the results of a running service in layers of `viewer` as they come.

    Parameters
    ----------
    viewer : napari.Viewer
    url : str
        Address of the service, as ``http://board:8080``.
    token : str, optional
        Its token.

    Returns
    -------
    napari.qt.threading.GeneratorWorker
        The thread that asks for results; ``quit()`` ends it.
    """
    from napari.qt.threading import create_worker

    def results() -> Iterator[Dict[str, Any]]:
        for frame in Live(url, token):
            yield images_of(frame)

    def show(images: Dict[str, Any]) -> None:
        for image, look, _ in layers(images, "live "):
            if look["name"] in viewer.layers:
                viewer.layers[look["name"]].data = image
            else:
                viewer.add_image(image, **look)

    return create_worker(results, _connect={"yielded": show})


def live_widget(viewer: "napari.viewer.Viewer") -> Any:  # noqa: F821
    """A panel that asks for the address of a service and shows its results."""
    from magicgui.widgets import Container, LineEdit, PushButton

    url, token, button = LineEdit(label="address", value="http://127.0.0.1:8080"), LineEdit(label="token"), PushButton(text="show")
    workers: List[Any] = []

    def start() -> None:
        while workers:
            workers.pop().quit()
        workers.append(live(viewer, url.value, token.value or None))

    button.clicked.connect(start)
    return Container(widgets=[url, token, button])
