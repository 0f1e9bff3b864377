# SPDX-License-Identifier: BSD-3-Clause
"""`Stage`: a camera that looks at a display, in time. `cells`, `change`: what tells two of its frames apart.

A frame is compared by the means of square cells, about 64 along its shorter side: fine enough for a torn
strip or a single bright spot, coarse enough to average noise.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl.acquisition.rig import check_photograph, to_unit
from ltcl.errors import AcquisitionError

_ACROSS = 64


class Frame(NamedTuple):
    """A frame as the camera gave it, its cells, and a time before which its exposure may have begun."""

    codes: np.ndarray  # (H, W) or (H, W, 3)
    cells: np.ndarray  # (a, b, channels) float32, of full scale
    time: float


def cells(image: np.ndarray) -> np.ndarray:
    """Means over square cells: (H, W) or (H, W, c) -> (a, b, c), float32.

    Examples
    --------
    >>> cells(np.ones((480, 640), np.float32)).shape, cells(np.ones((3, 4, 3), np.float32)).shape
    ((68, 91, 1), (3, 4, 3))
    """
    h, w = image.shape[:2]
    side = max(1, min(h, w) // _ACROSS)
    small = image if side == 1 else cv2.resize(image, (w // side, h // side), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small.reshape(*small.shape[:2], -1), np.float32)


def change(a: Frame, b: Frame) -> float:
    """The largest difference of a cell between two frames, of full scale."""
    return float(np.abs(a.cells - b.cells).max())


class Stage:
    """A camera and a display, and when the last of them was changed.

    Parameters
    ----------
    camera : Camera
    display : Display
    """

    def __init__(self, camera: Any, display: Any) -> None:
        self.camera, self.display = camera, display
        self.seconds: float | None = None  # of exposure, once set
        self._changed = -float("inf")
        self._kind: tuple[tuple[int, ...], np.dtype] | None = None

    def show(self, codes: np.ndarray) -> None:
        """Show codes from now on."""
        self.display.show(codes)
        self._changed = time.monotonic()

    def expose(self, seconds: float) -> None:
        """Expose so long from now on."""
        if seconds != self.seconds:
            self.seconds = None
            self.camera.expose(seconds)
            self.seconds, self._changed = seconds, time.monotonic()

    def settle(self, seconds: float) -> None:
        """Wait until so many seconds after the last change; old frames must not stay in a queue meanwhile."""
        while (left := seconds - self.since(time.monotonic())) > 0:
            if self.camera.stream:
                self.camera.frame()
            else:
                time.sleep(left)

    def since(self, moment: float) -> float:
        """Seconds from the last change to `moment`."""
        return moment - self._changed

    def frame(self) -> Frame:
        """The next frame. Its time is that of its arrival from a stream, else that of the shutter's release.

        Raises
        ------
        AcquisitionError
            None comes, or it is no picture, or one unlike those before.
        """
        asked = time.monotonic()
        codes = np.asarray(self.camera.frame())
        moment = time.monotonic() if self.camera.stream else asked
        check_photograph("the frame", codes, self.camera.channels)
        kind = (codes.shape, codes.dtype)
        if self._kind is not None and kind != self._kind:
            raise AcquisitionError(
                f"the frame is {codes.dtype} {codes.shape}; it must be {self._kind[1]} {self._kind[0]}, "
                "as the first was"
            )
        self._kind = kind
        return Frame(codes, cells(to_unit("the frame", codes, self.camera)), moment)
