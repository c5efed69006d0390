"""The compiled part of the package."""

from typing import Any, Dict, List, Optional, Tuple, TypedDict

import numpy as np
import numpy.typing as npt

__version__: str

class Error(ValueError): ...

class Mask:
    @staticmethod
    def stripes(angles: List[float], count: int, extinction_ratio: float) -> Mask: ...
    @staticmethod
    def measured(transmission: npt.NDArray[np.float32], angles: List[float]) -> Mask: ...

class Device:
    @staticmethod
    def build(
        psf: npt.NDArray[np.float32], frame: Tuple[int, ...], *, mask: Optional[Mask], channels: int, crop: Optional[List[int]], bin: int,
        levels: Tuple[float, float], noise: Tuple[float, float], dark: Optional[npt.NDArray[np.float32]], white: Optional[List[float]],
        margin: Optional[int], homography: Optional[List[float]],
    ) -> Device: ...
    @staticmethod
    def load(path: str) -> Device: ...
    @property
    def size(self) -> Tuple[int, int]: ...
    @property
    def frame(self) -> Tuple[int, int]: ...
    @property
    def channels(self) -> int: ...
    @property
    def angles(self) -> List[float]: ...
    @property
    def digest(self) -> str: ...

class Solved(TypedDict):
    stokes: npt.NDArray[np.float32]
    angles: Optional[npt.NDArray[np.float32]]
    valid: npt.NDArray[np.bool_]
    report: str

class Pipeline:
    def __init__(
        self, device: Device, *, guided: bool, method: Optional[str], iterations: Optional[int], fusion: str, precision: str,
        threads: Optional[int], register: bool, refit_psf: bool, video: bool,
    ) -> None: ...
    def solve(
        self, raw: npt.NDArray[Any], guide: Optional[npt.NDArray[Any]], *, interleaved: Tuple[bool, bool], counts: bool
    ) -> Solved: ...
    @property
    def method(self) -> str: ...

class Simulation:
    def __init__(self, spec: str) -> None: ...
    def capture(self, index: int) -> Tuple[npt.NDArray[np.uint16], npt.NDArray[np.float32], npt.NDArray[np.float32]]: ...
    def write_bundle(self, path: str) -> None: ...

def evaluate(estimate: npt.NDArray[np.float32], truth: npt.NDArray[np.float32]) -> Dict[str, float]: ...
def read_image(path: str) -> npt.NDArray[Any]: ...
