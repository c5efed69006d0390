"""Simulated captures and scores."""

from __future__ import annotations

import os
import tempfile
from typing import Any, Dict, Union

import numpy as np

from . import _native
from ._arrays import numbers
from ._device import Device
from ._pipeline import Result


class Capture:
    """One simulated pair of frames with the truth.

    Attributes
    ----------
    raw : ndarray of uint16, shape [H, W] or [3, H, W]
        Counts of the lensless sensor.
    guide : ndarray of float32, shape [H, W] or [3, H, W]
        Frame of the guide camera, 0 to 1.
    truth : ndarray of float32, shape [P, H, W] or [3, P, H, W]
        True intensities behind ideal polarizers at 0°, 45°, 90° (and 135°), fractions of full scale.
    device : Device
        The device as its bundle describes it.
    """

    def __init__(self, simulation: _native.Simulation, index: int) -> None:
        self._simulation = simulation
        self.raw, self.guide, self.truth = simulation.capture(index)
        with tempfile.TemporaryDirectory() as folder:
            simulation.write_bundle(folder)
            self.device = Device.load(folder)

    def save(self, path: Union[str, os.PathLike]) -> None:
        """Writes bundle, ``raw.npy``, ``guide.npy`` and ``truth.npy`` into the folder `path`, as ``stokescope simulate`` does."""
        folder = os.fspath(path)
        self._simulation.write_bundle(folder)
        for name in ("raw", "guide", "truth"):
            np.save(os.path.join(folder, f"{name}.npy"), getattr(self, name))


def simulate(scene: str = "plastic", *, index: int = 0, **settings: Any) -> Capture:
    """Simulates a device and one capture of a scene, as ``stokescope simulate`` does.

    Parameters
    ----------
    scene : str
        ``plastic``, ``spheres``, ``wedges`` or ``tissue``; or a calibration target: ``dark``, ``point``, ``uniform``, ``film``, ``print``.
    index : int
        Number of the frame; scenes move, ten frames a second.
    **settings
        Settings of the simulator: ``size`` in pixels or (width, height), ``angles`` (3 or 4), ``color`` ("gray" or "rgb"), ``stripes``,
        ``noise`` and ``shot`` (fractions of full scale), ``bits``, ``black``, ``seed``, ``imperfect`` ("all" or names joined by ``+``),
        ``knowledge`` ("nominal" or "exact") and others that the message about an unknown one lists.
    """
    settings = {"fine": 3, **settings}
    if "noise" in settings:
        settings.setdefault("shot", repr(settings["noise"] ** 2))
    if isinstance(settings.get("size"), (tuple, list)):
        settings["size"] = "x".join(map(str, settings["size"]))
    return Capture(_native.Simulation(",".join([scene, *(f"{key}={value}" for key, value in settings.items())])), index)


def evaluate(estimate: Any, truth: Any) -> Dict[str, float]:
    """Errors of an estimate against the truth.

    Parameters
    ----------
    estimate : Result or array_like, shape [P, H, W] or [C, P, H, W]
        Intensities behind ideal polarizers at 0°, 45°, 90° and, where there are four, 135°, fractions of full scale.
    truth : array_like, the same shape
        The true ones.

    Returns
    -------
    dict
        ``psnr`` in dB, ``ssim``, ``s12_psnr`` in dB, ``dolp_mae`` and ``aolp_mae_deg`` in degrees.
    """
    if isinstance(estimate, Result):
        if estimate.angles is None:
            raise _native.Error("the result has no angle images: its device has no mask")
        estimate = estimate.angles
    arrays = (np.ascontiguousarray(numbers(name, value), np.float32) for name, value in (("estimate", estimate), ("truth", truth)))
    return _native.evaluate(*arrays)
