# SPDX-License-Identifier: BSD-3-Clause
"""A pattern of blocks, photographed in the calibration and again after each batch of a scan.

If it does not show the same light as before (`agreement`), something moved during the batch, or
the light changed. The edges of the batch's patterns tell from which pattern on: with a picture y
and white w, both less ambient light, and the pattern p on the camera's pixels, least squares give
the movement d of

    p y / w = p s (p + d . grad p)

The factor p leaves out pixels with nothing but indirect light.

A lamp that fades scales all light of the projector: with the light x of the pattern in the
calibration and y now, both less ambient light, the gain is g = sum y / sum x. It counts if the
contrast says the same, g = cov(x, y) / var(x): the sum does not change where something moves, and
the contrast hardly where another light is on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from ltcl.acquisition.agreement import CameraModel, Deviation, find_deviation, spread
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.radiance import RadiancePicture, planes, values_at
from ltcl.acquisition.scratch import ImageFile, StoredImage, row_strips

# Share of the median of white below which pixels are left out.
MIN_WHITE_SHARE = 0.1
# Least s, so that d is finite.
MIN_SCALE = 0.05
# Change of the lamp since the calibration below which it is none, as shutters repeat themselves no
# better, in standard deviations of noise as well; and the largest that is corrected.
MIN_LAMP_CHANGE = 0.01
LAMP_SIGMAS = 5.0
MAX_LAMP_CHANGE = 0.15
# Difference of the two measures of a change, relative to it, that is allowed.
MAX_LAMP_DOUBT = 0.25
# Relative variance of the light of blocks, below which their contrast tells nothing.
MIN_CONTRAST = 0.05
# Movement in camera pixels that is clear; and the least median cosine of its angle with those of
# other pictures, if all are that of the camera. Single pixels exaggerate large movements.
MIN_MOVEMENT = 0.3
MIN_COSINE = 0.8


def sparse_pattern(grid: tuple[int, int]) -> np.ndarray:
    """Codes (h, w) with one pixel of sixteen on, the middle one among them."""
    height, width = grid
    rows = (np.arange(height) - height // 2) % 4 == 0
    columns = (np.arange(width) - width // 2) % 4 == 0
    return np.outer(rows, columns).astype(np.float32)


def pattern(grid: tuple[int, int]) -> np.ndarray:
    """Codes (h, w): blocks of 2 x 2 pixels from odd rows and columns on, on or off at random."""
    height, width = grid
    random = np.random.default_rng(0)
    coarse = random.random((height // 2 + 1, width // 2 + 1)) < 0.5
    fine = np.kron(coarse, np.ones((2, 2)))
    return fine[1 : height + 1, 1 : width + 1].astype(np.float32)


def marked(batch: Sequence[np.ndarray]) -> np.ndarray:
    """The pattern, changed by 1 / 255 of the first codes of a batch.

    So the pattern after each batch has its own entry in a list of photographs.
    """
    first_codes = batch[0]
    return np.abs(pattern(first_codes.shape[:2]) - first_codes / np.float32(255.0))


@dataclass(frozen=True, repr=False, eq=False)
class Anchor:
    """Radiance (n, c) of the pattern in the calibration, ambient light included, and its variance.

    `pixels` (n,) of the photograph, row by row, are some of those that see the projector.
    """

    pixels: np.ndarray
    value: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, picture: RadiancePicture, resampling: Resampling) -> Self:
        """The anchor of a picture (H, W[, c]) of the pattern."""
        seen = resampling.camera_pixels()
        is_valid = values_at(picture, seen, "valid").all(axis=1)
        pixels = spread(seen[is_valid])
        return cls(
            pixels=pixels,
            value=values_at(picture, pixels, "value"),
            variance=values_at(picture, pixels, "variance"),
        )

    def deviation(
        self,
        codes: np.ndarray,
        seconds: float,
        camera: CameraModel,
        room: np.ndarray,
        gain: float = 1.0,
    ) -> Deviation | None:
        """Compare a photograph of the pattern with that of the calibration.

        `codes` and the ambient light `room` are those at `pixels`, (n, c); `gain` is that of the
        lamp since then.
        """
        value = self.value
        if gain != 1.0:
            value = room + gain * (self.value - room)
        known = value, self.variance
        return find_deviation([codes], [seconds], camera, known)

    def lamp_gain(
        self, codes: np.ndarray, seconds: float, camera: CameraModel, room: np.ndarray
    ) -> float:
        """Gain of the lamp since the calibration, by a photograph of the pattern.

        `codes` and the ambient light `room` are those at `pixels`, (n, c). It is 1 if there is no
        change, or another one than that of the lamp.
        """
        curve = codes if codes.shape[1] > 1 else codes[:, 0]
        linear = camera.response.linear(curve).reshape(codes.shape)
        is_clear = (linear < camera.noise.saturation).all(axis=1)
        room = room[is_clear]
        x = (self.value[is_clear] - room).sum(axis=1, dtype=np.float64)
        y = ((linear - camera.offset)[is_clear] / seconds - room).sum(axis=1, dtype=np.float64)
        if len(x) < 2 or x.sum() <= 0 or x.var() < MIN_CONTRAST * x.mean() ** 2:
            return 1.0
        by_sum = float(y.sum() / x.sum())
        by_contrast = float(np.cov(x, y)[0, 1] / x.var(ddof=1))
        noise = self.variance[is_clear].sum()
        noise += camera.noise.variance(linear[is_clear]).sum() / seconds**2
        least_change = max(MIN_LAMP_CHANGE, LAMP_SIGMAS * float(np.sqrt(noise) / x.sum()))
        change = abs(by_sum - 1.0)
        doubt = abs(by_sum - by_contrast)
        is_of_lamp = doubt <= max(least_change, MAX_LAMP_DOUBT * change)
        if is_of_lamp and least_change < change < MAX_LAMP_CHANGE:
            return by_sum
        return 1.0


def compact(picture: RadiancePicture, file: ImageFile) -> StoredImage:
    """A picture in a file, in as little room as `shift_of` needs.

    (H, W[, c]) float16, NaN where it is not valid.
    """
    stored = file.reserve(picture.shape, np.float16)
    for rows in row_strips(picture.shape):
        strip = picture.rows(rows)
        values = np.where(strip.valid, strip.value, np.nan).astype(np.float16)
        stored.write(rows.start, values)
    return stored


def shift_of(
    codes: np.ndarray,
    picture: StoredImage,
    white: RadiancePicture,
    ambient: RadiancePicture,
    resampling: Resampling,
) -> np.ndarray:
    """Movement d along x and y, in camera pixels, of a `compact` picture under some codes."""
    grey = codes if codes.ndim == 2 else codes.mean(axis=2)
    P = grey.ravel()
    p = _pattern_on_camera(P, resampling)
    w = np.zeros(resampling.camera_grid, np.float32)
    for light in planes(white, "value"):
        w += light
    least_light = MIN_WHITE_SHARE * np.median(w[w > 0])
    # Normal equations, A^T A x = A^T b, so that rows add up.
    normal = np.zeros((3, 3))
    right = np.zeros(3)
    for rows in row_strips(picture.shape):
        dy, dx = _gradient(p, rows)
        y = _sum_of_channels(picture.read(rows) - ambient.rows(rows).value)
        edge = ((dx != 0) | (dy != 0)) & np.isfinite(y) & (w[rows] > least_light)
        p_of_edge = p[rows][edge].astype(np.float64)
        columns = np.stack([dx[edge], dy[edge], p_of_edge], axis=1)
        A = columns * p_of_edge[:, None]
        normal += A.T @ A
        right += A.T @ (p_of_edge * y[edge] / w[rows][edge])
    solution = np.linalg.pinv(normal) @ right
    scale = float(solution[2])
    return solution[:2] / max(scale, MIN_SCALE)


def _pattern_on_camera(P: np.ndarray, resampling: Resampling) -> np.ndarray:
    """Codes (N,) of the projector's pixels on those of the camera, (H, W) float32."""
    weights = resampling.weights
    lengths = np.diff(np.asarray(weights.indptr))
    total = np.zeros(math.prod(resampling.camera_grid), np.float32)
    p = np.zeros_like(total)
    magnitudes = np.abs(weights.data)
    np.add.at(total, weights.indices, magnitudes)
    np.add.at(p, weights.indices, magnitudes * np.repeat(P.astype(np.float32), lengths))
    p /= np.maximum(total, np.float32(1e-9))
    return p.reshape(resampling.camera_grid)


def _gradient(p: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives along rows and columns of some rows of a picture, as of the whole one."""
    top = max(rows.start - 1, 0)
    window = p[top : rows.stop + 1].astype(np.float64)
    inside = slice(rows.start - top, rows.stop - top)
    down = np.asarray(np.gradient(window, axis=0))
    right = np.asarray(np.gradient(window, axis=1))
    return down[inside], right[inside]


def _sum_of_channels(picture: np.ndarray) -> np.ndarray:
    """(H, W) of a picture (H, W[, c])."""
    return picture.reshape(*picture.shape[:2], -1).sum(axis=2)


def first_moved(shifts: Sequence[np.ndarray], moved: np.ndarray) -> int:
    """The first picture from which on most are moved rather than not; else the number of pictures.

    >>> d = [np.array([x, 0.0]) for x in (0.02, -0.03, 0.2, 0.1, 0.1)]
    >>> first_moved(d, np.array([0.12, 0.0]))
    2
    """
    length = max(moved @ moved, 1e-12)
    along = np.array([moved @ shift for shift in shifts]) / length
    evidence = np.clip(along, 0.0, 1.0) - 0.5
    return int(np.argmin(np.cumsum([0.0, *evidence])))


def are_moved_alike(shifts: Sequence[np.ndarray]) -> bool:
    """True if the last of some pictures is clearly moved, and most of them in its direction.

    >>> are_moved_alike([np.array([x, 0.5]) for x in (1.0, 2.2, 1.1)])
    True
    >>> are_moved_alike([np.array([x, 0.5]) for x in (-1.0, 3.0, 1.1)])
    False
    """
    *earlier, last = shifts
    if not earlier:
        return False
    lengths = np.linalg.norm(shifts, axis=1)
    if np.median(lengths) < MIN_MOVEMENT or lengths[-1] < MIN_MOVEMENT:
        return False
    cosines = (np.stack(earlier) @ last) / np.maximum(lengths[:-1] * lengths[-1], 1e-12)
    return float(np.median(cosines)) >= MIN_COSINE
