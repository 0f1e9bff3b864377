# SPDX-License-Identifier: BSD-3-Clause
"""A pattern of blocks that is photographed in the calibration, and again after each batch of a scan.

Where it does not show the same light as before (`agreement`), something moved during the batch, or
the light changed. From which pattern on, the batch shows at the edges of its patterns: with a
picture y and white w, both less ambient light, and the pattern p on the camera's pixels, least
squares give the movement d of

    p y / w = p s (p + d . grad p)

where the factor p leaves out pixels with nothing but indirect light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from ltcl.acquisition.agreement import CameraModel, Deviation, find_deviation, sample, spread
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.radiometry import Radiance

_DARK = 0.1  # of the median of white: pixels below are left out
_LEAST = 0.05  # s at least, so that d is finite


def pattern(grid: tuple[int, int]) -> np.ndarray:
    """Codes (h, w): blocks of 2 x 2 pixels from odd rows and columns on, on or off at random."""
    coarse = np.random.default_rng(0).random((grid[0] // 2 + 1, grid[1] // 2 + 1)) < 0.5
    return np.kron(coarse, np.ones((2, 2)))[1 : grid[0] + 1, 1 : grid[1] + 1].astype(np.float32)


def marked(batch: Sequence[np.ndarray]) -> np.ndarray:
    """The pattern, changed by 1 / 255 of the first codes of a batch: so each has its own entry in a list."""
    return np.abs(pattern(batch[0].shape[:2]) - batch[0] / np.float32(255.0))


@dataclass(frozen=True, repr=False, eq=False)
class Anchor:
    """What a calibration saw of the pattern: radiance (n, c), ambient light included, and its variance.

    `pixels` (n,) of the photograph, row by row, are some of those that see the projector.
    """

    pixels: np.ndarray
    value: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, shown: Radiance, R: Resampling) -> Self:
        """From a picture (H, W[, c]) of the pattern."""
        seen = np.unique(R.weights.indices)
        pixels = spread(seen[sample(shown.valid, seen).all(axis=1)])
        return cls(pixels, sample(shown.value, pixels), sample(shown.variance, pixels))

    def deviation(self, image: np.ndarray, seconds: float, sensor: CameraModel) -> Deviation | None:
        """Whether a photograph (H, W[, c]) of the pattern deviates from that of the calibration."""
        known = self.value, self.variance
        return find_deviation([sample(image, self.pixels)], [seconds], sensor, known)


def compact(picture: Radiance) -> np.ndarray:
    """A picture in as little memory as `shift_of` needs, (H, W[, c]) float16, NaN where it is not valid."""
    return np.where(picture.valid, picture.value, np.nan).astype(np.float16)


def shift_of(
    codes: np.ndarray, picture: np.ndarray, white: Radiance, ambient: Radiance, R: Resampling
) -> np.ndarray:
    """d along x and y, in camera pixels, of a `compact` picture under codes (h, w[, c])."""
    P = (codes if codes.ndim == 2 else codes.mean(axis=2)).ravel()
    weights = abs(R.weights).T
    total = weights @ np.ones(len(P))
    p = (weights @ P / np.maximum(total, 1e-9)).reshape(R.camera_grid)
    dy, dx = np.gradient(p)
    lit, w = (x.reshape(*p.shape, -1).sum(axis=2) for x in (picture - ambient.value, white.value))
    edge = ((dx != 0) | (dy != 0)) & np.isfinite(lit) & (w > _DARK * np.median(w[w > 0]))
    A = np.stack([dx[edge], dy[edge], p[edge]], axis=1) * p[edge, None]
    d = np.linalg.lstsq(A, p[edge] * lit[edge] / w[edge])[0]
    return d[:2] / max(d[2], _LEAST)


def first_moved(shifts: Sequence[np.ndarray], moved: np.ndarray) -> int:
    """The first of pictures from which on most of them are moved rather than not; their number: none.

    >>> d = [np.array([x, 0.0]) for x in (0.02, -0.03, 0.2, 0.1, 0.1)]
    >>> first_moved(d, np.array([0.12, 0.0]))
    2
    """
    along = np.array([moved @ d for d in shifts]) / max(moved @ moved, 1e-12)
    return int(np.argmin(np.cumsum([0.0, *np.clip(along, 0.0, 1.0) - 0.5])))
