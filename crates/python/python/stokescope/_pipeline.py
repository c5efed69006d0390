"""Pipelines: planned once for a device, then one call a frame."""

from __future__ import annotations

import json
from functools import cached_property
from typing import Any, Dict, List, Optional

import numpy as np

from . import _native
from ._arrays import image
from ._device import Device


class Polarization:
    """Stokes images of one frame and what follows from them.

    Attributes
    ----------
    stokes : ndarray of float32, shape [3, H, W] or [C, 3, H, W]
        S0, S1 and S2 as fractions of full scale; S0 alone, [1, H, W] or [C, 1, H, W], without a mask.
    """

    def __init__(self, stokes: np.ndarray) -> None:
        self.stokes = stokes

    @property
    def s0(self) -> np.ndarray:
        """Intensity, fractions of full scale, [H, W] or [C, H, W]."""
        return self.stokes[..., 0, :, :]

    intensity = s0

    @cached_property
    def _summed(self) -> Optional[np.ndarray]:
        if self.stokes.shape[-3] == 1:
            return None
        return self.stokes if self.stokes.ndim == 3 else self.stokes.sum(0)

    @cached_property
    def dolp(self) -> Optional[np.ndarray]:
        """Degree of linear polarization √(S1² + S2²)/S0, [H, W], of colours summed; noise may push it above 1. 0 where S0 ≤ 0, None
        without a mask."""
        if self._summed is None:
            return None
        s0, s1, s2 = self._summed
        return np.divide(np.hypot(s1, s2), s0, out=np.zeros_like(s0), where=s0 > 0)

    @cached_property
    def aolp(self) -> Optional[np.ndarray]:
        """Angle of linear polarization ½·atan2(S2, S1) in degrees, 0 to below 180, [H, W], of colours summed; None without a mask. Average
        S1 and S2, never angles."""
        if self._summed is None:
            return None
        _, s1, s2 = self._summed
        degrees = np.degrees(np.arctan2(s2, s1)) * np.float32(0.5)
        degrees = np.where(degrees < 0, degrees + np.float32(180), degrees)
        return np.where(degrees < 180, degrees, np.float32(0))


class Result(Polarization):
    """The polarization of one frame. Its arrays are its own: neither the pipeline nor a later frame changes them.

    Attributes
    ----------
    stokes : ndarray of float32, shape [3, H, W] or [C, 3, H, W]
        S0, S1 and S2 as fractions of full scale; S0 alone, [1, H, W] or [C, 1, H, W], without a mask.
    angles : ndarray of float32, shape [P, H, W] or [C, P, H, W], or None
        Intensities behind ideal polarizers at the angles of the mask, fractions of full scale; None without a mask.
    errors : ndarray of float32, shaped like `stokes`
        Standard error of each value of `stokes`, one σ, as in ``stokes_error.npy`` of the command line.
    valid : ndarray of bool, shape [H, W]
        Pixels that can be trusted: neither dark nor read through a pixel that is saturated or defective.
    readings : ndarray of float32, shape [H, W] or [C, H, W]
        The readings that `stokes` explains, fractions of full scale: cropped, binned, less the black level or the dark frame, and less the
        light from beyond the frame where that was found.
    report : dict
        Figures of the frame, as in ``report.json`` of the command line.
    warnings : list of str
        Facts to know before trusting the result.
    """

    def __init__(self, solved: Any) -> None:
        super().__init__(solved["stokes"])
        self.errors: np.ndarray = solved["errors"]
        self.angles: Optional[np.ndarray] = solved["angles"]
        self.valid: np.ndarray = solved["valid"]
        self.readings: np.ndarray = solved["readings"][..., 0, :, :]
        self.report: Dict[str, Any] = json.loads(solved["report"])
        self.warnings: List[str] = self.report["warnings"]

    @cached_property
    def _propagated(self) -> List[Optional[np.ndarray]]:
        if self.stokes.shape[-3] == 1:
            return [None, None]
        planes = (-1, *self.stokes.shape[-2:])
        return _native.propagate(self.stokes.reshape(planes), self.errors.reshape(planes))

    @property
    def dolp_error(self) -> Optional[np.ndarray]:
        """Standard error of `dolp`, [H, W], propagated from `errors` to first order; 0 where S0 ≤ 0, None without a mask."""
        return self._propagated[0]

    @property
    def aolp_error(self) -> Optional[np.ndarray]:
        """Standard error of `aolp` in degrees, [H, W], propagated from `errors` to first order; NaN where the angle means nothing, as
        √(S1² + S2²) is not above its standard error. None without a mask."""
        return self._propagated[1]

    def __repr__(self) -> str:
        shape = "×".join(map(str, self.stokes.shape))
        return f"Result(stokes {shape}, {self.report['method']}, {self.report['iterations']} iterations, {len(self.warnings)} warning(s))"


class Pipeline:
    """A solver planned for one device. Call it with a raw frame and its guide; every call gives a :class:`Result`.

    Parameters
    ----------
    device : Device
        The camera.
    iterations : int, optional
        Iterations of the solver; the usual number of the method unless given.
    guided : bool
        Whether frames come with a guide.
    method : str, optional
        ``guided``, ``stokes``, ``fista``, ``fista-published`` (also ``-scaled``, ``-frame``), ``admm`` or
        ``admm-published``; the usual one unless given.
    fusion : str
        Learned second stage: ``off``, ``auto`` (currently off), the name of a shipped model (``default``, ``preview``), or a model's folder.
    precision : {"f32", "int8"}
        Number format of that model.
    threads : int, optional
        Threads of the solver; all cores unless given. Sums are split among them, so that their number changes results by rounding.
    register : bool
        Whether every guide is aligned with its frame.
    refit_psf : bool
        Whether the PSF's size is refitted where the readings show that it has changed.
    video : bool
        Whether frames follow each other, so that each may start from the last one.

    Notes
    -----
    Python's global lock is released while a frame is solved, so several pipelines work at once in threads. One pipeline solves one frame
    at a time; further callers wait. Without `video` a frame gives the same result whatever was solved before it. The arrays must not be
    written to until the call returns.
    """

    def __init__(
        self,
        device: Device,
        *,
        iterations: Optional[int] = None,
        guided: bool = True,
        method: Optional[str] = None,
        fusion: str = "auto",
        precision: str = "f32",
        threads: Optional[int] = None,
        register: bool = True,
        refit_psf: bool = True,
        video: bool = False,
    ) -> None:
        self.device = device
        self._native = _native.Pipeline(
            device._native, guided=guided, method=method, iterations=iterations, fusion=str(fusion), precision=precision, threads=threads,
            register=register, refit_psf=refit_psf, video=video,
        )

    @property
    def method(self) -> str:
        """Name of the method."""
        return self._native.method

    def __call__(self, raw: Any, guide: Any = None, *, unit: Optional[str] = None) -> Result:
        """Solves one frame.

        Parameters
        ----------
        raw : array_like, shape [H, W], [3, H, W] or [H, W, 3]
            Readings of the lensless sensor. Integers are counts; floating-point readings are fractions of full scale, less the black level.
        guide : array_like, shape [H, W], [3, H, W] or [H, W, 3], optional
            Frame of the ordinary camera, of any scale.
        unit : {"counts", "full-scale"}, optional
            Unit of `raw` where its number format does not tell, as of averaged counts.

        Returns
        -------
        Result
            Images, report and warnings.

        Raises
        ------
        Error
            A frame of another shape than the device's, or without a reading that can be used.
        """
        if unit not in (None, "counts", "full-scale"):
            raise _native.Error(f"unit = {unit!r}, allowed: 'counts', 'full-scale'")
        raw, raw_last = image("raw", raw)
        if unit == "full-scale" and raw.dtype.kind == "u":
            raw = raw.astype(np.float32)
        guide_last = False
        if guide is not None:
            guide, guide_last = image("guide", guide)
            if guide.dtype.kind == "u":
                # the gain is fitted in any case; about 1 keeps the gain in the report comparable
                guide = guide.astype(np.float32) / np.float32(65535 if guide.max() > 255 else 255)
        solved = self._native.solve(raw, guide, interleaved=(raw_last, guide_last), counts=unit == "counts")
        return Result(solved)
