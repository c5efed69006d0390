"""Arrays as the compiled part takes them: of three axes, contiguous, and of a number format that it knows."""

from __future__ import annotations

from typing import Any, Tuple

import numpy as np

from ._native import Error

SHAPES = "[H, W], [1, H, W], [3, H, W] or [H, W, 3]"


def image(name: str, value: Any) -> Tuple[np.ndarray, bool]:
    """`value` as an image of three axes, and whether its channels come last. Copies only what is not of 8 or 16 bits, single or double
    precision, contiguous and of this machine's byte order."""
    array = numbers(name, value)
    if array.ndim == 2:
        array = array[None]
    interleaved = array.ndim == 3 and array.shape[0] not in (1, 3) and array.shape[2] == 3
    if array.ndim != 3 or 0 in array.shape or not (interleaved or array.shape[0] in (1, 3)):
        raise Error(f"{name}: shape {list(np.shape(value))}, allowed: {SHAPES}")
    return np.ascontiguousarray(array), interleaved


def numbers(name: str, value: Any) -> np.ndarray:
    """`value` as an array of u8, u16, f32 or f64."""
    array = np.asarray(value)
    kind, width = array.dtype.kind, array.dtype.itemsize
    if kind == "u" and width <= 2 or kind == "f" and width in (4, 8):
        return array.astype(array.dtype.newbyteorder("="), copy=False)
    if kind == "f":
        return array.astype(np.float32 if width == 2 else np.float64)
    if kind in "iu":
        low, high = (array.min(), array.max()) if array.size else (0, 0)
        if low < 0 or high > 65535:
            raise Error(f"{name}: counts from {low} to {high}, allowed: 0 to 65535")
        return array.astype(np.uint16)
    raise Error(f"{name}: data type {array.dtype}, allowed: integers (counts) or floating point")


def planes(name: str, value: Any) -> np.ndarray:
    """`value` as `[planes, H, W]` of single precision."""
    array, interleaved = image(name, value)
    return np.ascontiguousarray(np.moveaxis(array, 2, 0) if interleaved else array, np.float32)
