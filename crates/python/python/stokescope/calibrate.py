"""Calibration from arrays: the dark frame and the point spread function. The command ``stokescope calibrate`` does all steps."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Dict, List, Optional, Sequence

import numpy as np

from . import _native
from ._arrays import planes
from ._device import Device, Mask


@dataclass(frozen=True)
class Measurement:
    """The quality of a calibration step."""

    good: bool
    """Whether the result is as good as it should be."""
    verdict: str
    """One sentence that says how good it is, or what to do."""
    quality: Dict[str, float]
    """Figures by name."""


@dataclass(frozen=True)
class Dark(Measurement):
    """A dark frame."""

    mean: np.ndarray
    """Counts, [H, W] or [3, H, W]."""
    black_level: float
    """Counts of a pixel without light."""
    read_noise: float
    """Standard deviation of a reading in the dark, a fraction of full scale."""


@dataclass(frozen=True)
class Psf(Measurement):
    """A point spread function."""

    psf: np.ndarray
    """[H, W] or [3, H, W], of sum 1 in each channel; its centre of light lies at half the size."""

    def __array__(self, dtype: Any = None, copy: Optional[bool] = None) -> np.ndarray:
        return np.array(self.psf, dtype)


def dark(frames: Sequence[Any], *, bits: int = 16, saturation: float = 65535.0) -> Dark:
    """Averages frames of the covered sensor.

    Parameters
    ----------
    frames : sequence of array_like, shape [H, W] or [3, H, W]
        Two or more frames in counts.
    bits : int
        Significant bits of a count.
    saturation : float
        Counts of a full pixel.

    Raises
    ------
    Error
        Frames that differ in shape, or light in them.
    """
    mean, black_level, read_noise, outcome = _native.calibrate_dark(_frames(frames), bits, saturation)
    return Dark(**_measurement(outcome), mean=mean, black_level=black_level, read_noise=read_noise)


def psf(frames: Sequence[Any], mask: Optional[Mask] = None, *, dark: Any = None, black_level: float = 0.0, saturation: float = 65535.0) -> Psf:
    """Averages frames of a point source into a PSF, which :class:`stokescope.Device` takes.

    Parameters
    ----------
    frames : sequence of array_like, shape [H, W] or [3, H, W]
        One or more frames in counts.
    mask : Mask, optional
        Polarizer mask through which the sensor sees the source.
    dark : array_like, optional
        Dark frame in counts.
    black_level, saturation : float
        Counts of a pixel without light and of a full one.

    Raises
    ------
    Error
        Frames that do not fit, no light, saturation, too weak a source, no point, or movement between the frames.
    """
    taken = _frames(frames)
    if not taken:
        raise _native.Error("frames: 0, allowed: 1 or more")
    channels, height, width = taken[0].shape
    point = np.zeros((height, width), np.float32)
    point[height // 2, width // 2] = 1
    sensor = Device(point, mask, channels=channels, black_level=black_level, saturation=saturation)
    found, outcome = _native.calibrate_psf(taken, sensor._native, None if dark is None else planes("dark", dark), mask is not None)
    return Psf(**_measurement(outcome), psf=found)


def _frames(frames: Sequence[Any]) -> List[np.ndarray]:
    return [planes("frames", frame) for frame in frames]


def _measurement(outcome: str) -> Dict[str, Any]:
    found = json.loads(outcome)
    return {key: found[key] for key in ("good", "verdict", "quality")}
