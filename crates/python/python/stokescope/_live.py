"""Results of the live service as they come."""

from __future__ import annotations

import io
import time
import urllib.error
import urllib.request
from typing import Iterator, Optional

import numpy as np

from . import _native
from ._pipeline import Polarization

TIMEOUT = 20.0


class LiveFrame(Polarization):
    """A result of the live service.

    Attributes
    ----------
    number : int
        Number of the frame since the service started.
    age : float
        Seconds since it was taken, when it was sent.
    """

    def __init__(self, number: int, age: float, stokes: np.ndarray) -> None:
        super().__init__(stokes)
        self.number, self.age = number, age


class Live:
    """The latest results of a running ``stokescope run``, each at most once. Frames that come faster than they are asked for are skipped.

    Parameters
    ----------
    url : str
        Address of the service, as ``http://board:8080``.
    token : str, optional
        Its token, which any address but this machine's needs.
    interval : float
        Shortest time between two requests in seconds.
    """

    def __init__(self, url: str, token: Optional[str] = None, *, interval: float = 0.1) -> None:
        self._request = urllib.request.Request(url.rstrip("/") + "/frame?of=stokes&format=npy")
        if token is not None:
            self._request.add_header("Authorization", f"Bearer {token}")
        self._interval = interval

    def latest(self) -> LiveFrame:
        """The latest result.

        Raises
        ------
        Error
            The service does not answer, or refuses; there is no result yet.
        """
        try:
            with urllib.request.urlopen(self._request, timeout=TIMEOUT) as answer:
                number, age = int(answer.headers["X-Frame"]), float(answer.headers["X-Age-Seconds"])
                return LiveFrame(number, age, np.load(io.BytesIO(answer.read()), allow_pickle=False))
        except urllib.error.HTTPError as e:
            raise _native.Error(f"{self._request.full_url}: {e.code}: {e.read().decode(errors='replace').strip()}") from e
        except (OSError, ValueError, TypeError) as e:
            raise _native.Error(f"{self._request.full_url}: {e}") from e

    def __iter__(self) -> Iterator[LiveFrame]:
        last = None
        while True:
            began = time.monotonic()
            frame = self.latest()
            if frame.number != last:
                last = frame.number
                yield frame
            time.sleep(max(0.0, self._interval - (time.monotonic() - began)))
