"""Devices: sensor, noise, PSF, mask and the place of the guide camera."""

from __future__ import annotations

import math
import os
from typing import Any, Optional, Sequence, Tuple, Union

import numpy as np

from . import _native
from ._arrays import numbers, planes

Mask = _native.Mask


def stripes(angles: Sequence[float], n: int, *, extinction_ratio: float = math.inf) -> Mask:
    """A mask of vertical polarizer stripes of equal width.

    Parameters
    ----------
    angles : sequence of float
        Angles of the polarizers in degrees, in the order of the stripes from left to right, repeated.
    n : int
        Number of stripes over the width of the frame.
    extinction_ratio : float
        Transmission along the polarizer over that across it; infinite for ideal polarizers.
    """
    return Mask.stripes([float(angle) for angle in angles], n, extinction_ratio)


def mosaic(rows: Sequence[Sequence[float]] = ((90, 45), (135, 0)), *, extinction_ratio: float = math.inf) -> Mask:
    """A mask of polarizers on single pixels, as on the sensors of polarization cameras.

    Parameters
    ----------
    rows : sequence of sequences of float
        Angles in degrees of the pixels of a small rectangle, row by row from the first pixel of the frame; it repeats over the sensor.
        That of the Sony IMX250MZR and IMX264MZR unless given.
    extinction_ratio : float
        Transmission along the polarizer over that across it; infinite for ideal polarizers.
    """
    return Mask.mosaic([[float(angle) for angle in row] for row in rows], extinction_ratio)


def measured(maps: Any, angles: Sequence[float]) -> Mask:
    """A mask measured pixel by pixel: stripes, polarizers on single pixels, or any other layout.

    Parameters
    ----------
    maps : array_like of float, shape [angles, H, W]
        Readings under unit light that is polarized at each of `angles`.
    angles : sequence of float
        The angles of that light in degrees; three or more.
    """
    maps = np.ascontiguousarray(numbers("maps", maps), np.float32)
    if maps.ndim != 3:
        raise _native.Error(f"maps: shape {list(maps.shape)}, allowed: [angles, H, W]")
    return Mask.measured(maps, [float(angle) for angle in angles])


class Device:
    """A lensless polarization camera and where its guide camera lies.

    Parameters
    ----------
    psf : array_like, shape [H, W], [C, H, W] or [H, W, C]
        Image of a point source, of any positive scale. A displacement of zero lies at half the size.
    mask : Mask, optional
        Polarizer mask, of :func:`stripes`, :func:`mosaic` or :func:`measured`. Without one the camera is an ordinary lensless one.
    channels : {1, 3}, optional
        Channels of the sensor; those of the PSF unless given.
    frame : (int, int), optional
        Height and width of the camera's frames in pixels; those of the PSF unless given.
    crop : (int, int, int, int), optional
        Column, row, width and height of the part of the frame that is used.
    bin : int
        Blocks of `bin` × `bin` readings become one.
    black_level, saturation : float
        Counts of a pixel without light and of a full one.
    noise : float or (float, float)
        Standard deviation of a reading in the dark as a fraction of full scale, and variance per unit of signal. The noise is also
        estimated from every frame.
    dark : array_like, optional
        Dark frame in counts, of one plane or one for each channel.
    white : (float, float, float), optional
        Factors of red, green and blue readings.
    margin : int, optional
        Pixels around the frame from which light may reach the sensor; 0 for a field stop.
    homography : array_like of float, shape [3, 3], optional
        Map from pixels of the camera's frame to pixels of the guide camera.

    Raises
    ------
    Error
        A value that cannot be, with what is allowed.
    """

    def __init__(
        self,
        psf: Any,
        mask: Optional[Mask] = None,
        *,
        channels: Optional[int] = None,
        frame: Optional[Tuple[int, int]] = None,
        crop: Optional[Tuple[int, int, int, int]] = None,
        bin: int = 1,
        black_level: float = 0.0,
        saturation: float = 65535.0,
        noise: Union[float, Tuple[float, float]] = 0.002,
        dark: Any = None,
        white: Optional[Tuple[float, float, float]] = None,
        margin: Optional[int] = None,
        homography: Any = None,
    ) -> None:
        spread = planes("psf", psf)
        read, shot = (noise, 0.0) if np.isscalar(noise) else noise
        self._native = _native.Device.build(
            spread,
            spread.shape[1:] if frame is None else tuple(frame),
            mask=mask,
            channels=spread.shape[0] if channels is None else channels,
            crop=None if crop is None else list(crop),
            bin=bin,
            levels=(black_level, saturation),
            noise=(read, shot),
            dark=None if dark is None else planes("dark", dark),
            white=None if white is None else list(white),
            margin=margin,
            homography=None if homography is None else [float(v) for v in np.asarray(homography).ravel()],
        )

    @classmethod
    def load(cls, path: Union[str, os.PathLike]) -> Device:
        """The device of a bundle: a folder with ``calibration.toml`` and its arrays."""
        device = cls.__new__(cls)
        device._native = _native.Device.load(os.fspath(path))
        return device

    @property
    def size(self) -> Tuple[int, int]:
        """Height and width of results, in pixels."""
        return self._native.size

    @property
    def frame(self) -> Tuple[int, int]:
        """Height and width of the camera's frames, in pixels."""
        return self._native.frame

    @property
    def channels(self) -> int:
        """1 (mono) or 3 (colour)."""
        return self._native.channels

    @property
    def angles(self) -> Tuple[float, ...]:
        """Angles of the polarizers in degrees; empty without a mask."""
        return tuple(self._native.angles)

    def __repr__(self) -> str:
        height, width = self.size
        angles = ", ".join(f"{angle:g}°" for angle in self.angles) or "no mask"
        return f"Device({width}×{height} pixels, {self.channels} channel(s), {angles})"
