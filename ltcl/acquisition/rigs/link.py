# SPDX-License-Identifier: BSD-3-Clause
"""`CameraLink`: shows codes on a display and takes frames of a camera, in time.

Frames are compared by the means of square cells, about 64 along the shorter side.
"""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl.acquisition.rig import to_unit

# Cells along the shorter side of a frame.
CELLS_ACROSS = 64


class CapturedFrame(NamedTuple):
    """A frame as the camera gave it, and when it came or its shutter opened."""

    codes: np.ndarray  # (H, W) or (H, W, 3)
    cells: np.ndarray  # (a, b, channels) float32, of full scale
    waited: float  # seconds since the last change of codes or exposure


class CameraLink:
    """A display of a grid (h, w), and a camera that watches it.

    `seconds` is the exposure that is set, 0 before the first one.
    """

    def __init__(self, camera: Any, display: Any, grid: tuple[int, int]) -> None:
        self.camera = camera
        self.display = display
        self.grid = grid
        self.is_stream = bool(camera.stream)
        self.seconds = 0.0
        self._changed_at = -math.inf
        # Shape and type of all frames.
        self._format: tuple[tuple[int, ...], np.dtype] | None = None

    def show(self, codes: np.ndarray) -> None:
        """Show codes (h, w) or (h, w, 3)."""
        self.display.show(codes)
        self._changed_at = time.monotonic()

    def show_uniform(self, code: float) -> None:
        """Show one code everywhere."""
        self.show(np.full(self.grid, code, np.float32))

    def expose(self, seconds: float) -> None:
        """Set the exposure, unless it is set already."""
        if seconds == self.seconds:
            return
        self.seconds = 0.0  # unknown after an error
        self.camera.expose(seconds)
        self.seconds = seconds
        self._changed_at = time.monotonic()

    def settle(self, seconds: float) -> None:
        """Wait until so many seconds after the last change; a stream's frames are dropped."""
        end = self._changed_at + seconds
        remaining = end - time.monotonic()
        while remaining > 0:
            if self.is_stream:
                self.camera.frame()
            else:
                time.sleep(remaining)
            remaining = end - time.monotonic()

    def frame(self) -> CapturedFrame:
        """The next frame."""
        released_at = time.monotonic()
        codes = np.asarray(self.camera.frame())
        moment = time.monotonic() if self.is_stream else released_at
        scaled = to_unit("the frame", codes, self.camera, self._format)
        self._format = (codes.shape, codes.dtype)
        return CapturedFrame(codes, cell_means(scaled), moment - self._changed_at)

    def frames(self, count: int) -> np.ndarray:
        """Cells of the next frames, (count, a, b, channels)."""
        return np.stack([self.frame().cells for _ in range(count)])


def cell_means(image: np.ndarray) -> np.ndarray:
    """Means over square cells: (H, W) or (H, W, c) -> (a, b, c), float32."""
    h, w = image.shape[:2]
    side = max(1, min(h, w) // CELLS_ACROSS)
    if side > 1:
        image = cv2.resize(image, (w // side, h // side), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image.reshape(*image.shape[:2], -1), np.float32)


def largest_change(a: CapturedFrame, b: CapturedFrame) -> float:
    """The largest difference of a cell, of full scale."""
    return float(np.abs(a.cells - b.cells).max())


def relative_drift(mean: np.ndarray, before: np.ndarray, min_brightness: float) -> float:
    """Largest difference of two means (channels,), relative to `min_brightness` at least."""
    return float(np.max(np.abs(mean - before) / np.maximum(before, min_brightness)))
