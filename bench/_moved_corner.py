# SPDX-License-Identifier: BSD-3-Clause
"""A camera before a corner whose projector moves, with light that is exact in both places.

The two walls of `_corner.Bounce` have n rows and 2 n columns of patches. A projector lights squares
of them, by the parts of patches that its pixels cover, and a camera with smaller pixels looks at
more than that. Direct light is that of the projector's pixels, by areas; light that bounced comes
from all patches, by as many products with the form factors as it takes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from _corner import Bounce
from ltcl.acquisition.rigs.simulated import SimulatedRig

# Patches that a projector pixel covers, rows and columns.
PIXEL_PATCHES = (1.5, 3.0)
# Camera pixels to a side of a projector pixel; projector pixels that it sees beyond the picture.
CAMERA_PIXELS = 3.1
SEEN_MARGIN = 6
AMBIENT = 0.01
# Light of a bounce, relative to the direct light, that is the last.
LAST_BOUNCE = 1e-7


class MovedCornerRig(SimulatedRig):
    """A projector of side x side pixels in the middle of a corner, and a camera.

    Parameters
    ----------
    side : int
        Pixels along both sides of the projector.
    albedo : float
        That of both walls.
    shift : (float, float)
        Rows and columns, in projector pixels, by which its picture has moved.
    lamp : float
        Light of the projector.
    turned : int
        Side of a square of the picture, in pixels, which a mirror turns upside down.
    **sensor
        Settings of `ltcl.acquisition.rigs.simulated.Sensor`.
    """

    def __init__(
        self,
        side: int,
        albedo: float,
        *,
        shift: tuple[float, float] = (0.0, 0.0),
        lamp: float = 1.0,
        turned: int = 0,
        ambient: float = AMBIENT,
        **sensor: Any,
    ) -> None:
        super().__init__((side, side), 1, sensor)
        self.shift = shift
        self.lamp = lamp
        start = side // 8
        self._turned = slice(start, start + turned)
        self.albedo = albedo
        self.ambient = ambient
        self.count = 0
        # A margin of a third of the picture all around it.
        patches = 2 * side
        self._bounce = Bounce(patches, albedo)
        count = round((side + 2 * SEEN_MARGIN) * CAMERA_PIXELS)
        self.camera_grid = (count, count)
        self._patches_of_projector = []
        self._camera_of_projector = []
        self._camera_of_patches = []
        for axis, width in enumerate(PIXEL_PATCHES):
            size = self._bounce.grid[axis]
            middle = size / 2.0
            pixels = middle + width * (np.arange(side + 1) - side / 2.0 + shift[axis])
            edges = np.arange(size + 1.0)
            seen = middle + width / CAMERA_PIXELS * (np.arange(count + 1) - count / 2.0)
            self._patches_of_projector.append(shares(edges, pixels))
            self._camera_of_projector.append(shares(seen, pixels))
            self._camera_of_patches.append(shares(seen, edges))
        self._facts = {"kind": "moved corner", "side": side, "albedo": albedo}

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Take a photograph, and count it."""
        self.count += 1
        return super().photograph(codes, seconds)

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        return self.light(self._light(codes))

    def light(self, pattern: np.ndarray) -> np.ndarray:
        """Light at the camera's pixels, (H, W), under linear light (h, w)."""
        power = self.lamp * self.albedo
        pattern = np.array(pattern)
        part = pattern[self._turned, self._turned]
        pattern[self._turned, self._turned] = part[::-1].copy()
        down, across = self._patches_of_projector
        bounce = (power * (down @ pattern @ across.T)).reshape(-1, 1)
        least = LAST_BOUNCE * max(bounce.max(), 1e-12)
        indirect = np.zeros_like(bounce)
        while bounce.max() > least:
            bounce = self._bounce.matmat(bounce).reshape(-1, 1)
            indirect += bounce
        rows, columns = self._camera_of_projector
        direct = power * (rows @ pattern @ columns.T)
        rows, columns = self._camera_of_patches
        return direct + rows @ indirect.reshape(self._bounce.grid) @ columns.T + self.ambient


def shares(wholes: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Share of each interval that lies in each of others; both are given by ascending edges."""
    start = np.maximum(wholes[:-1, None], parts[:-1])
    end = np.minimum(wholes[1:, None], parts[1:])
    return np.maximum(end - start, 0.0) / np.diff(wholes)[:, None]
