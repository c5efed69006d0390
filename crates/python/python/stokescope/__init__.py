"""Lensless polarization imaging: raw frames become Stokes images, as NumPy arrays.

A diffuser and a polarizer mask turn a bare sensor into a camera whose raw frame looks like noise. With the point spread function (PSF) of
the diffuser, the layout of the mask and one frame of an ordinary camera, the *guide*, a :class:`Pipeline` solves for the scene: intensity,
degree and angle of linear polarization.

>>> import stokescope as ss
>>> capture = ss.simulate("wedges", size=64)
>>> solve = ss.Pipeline(capture.device, iterations=10)
>>> r = solve(capture.raw, capture.guide)
>>> r.stokes.shape
(3, 64, 64)

Units: integers are counts of the sensor, floating-point readings and all results are fractions of its full scale, angles are degrees,
counter-clockwise from the rows of the sensor. Whatever cannot be worked with raises :class:`Error` with the value found and what is allowed.
"""

from . import calibrate
from ._batch import reconstruct_folder
from ._cluster import reprocess
from ._device import Device, Mask, measured, mosaic, stripes
from ._live import Live, LiveFrame
from ._native import Error, __version__
from ._pipeline import Pipeline, Polarization, Result
from ._session import Frame, Session, read
from ._simulate import Capture, evaluate, simulate

__all__ = [
    "Capture", "Device", "Error", "Frame", "Live", "LiveFrame", "Mask", "Pipeline", "Polarization", "Result", "Session", "__version__",
    "calibrate", "evaluate", "measured", "mosaic", "read", "reconstruct_folder", "reprocess", "simulate", "stripes",
]
