# SPDX-License-Identifier: BSD-3-Clause
"""A pattern of blocks that is photographed in the calibration, and again after each batch of a scan.

Where it does not show the same light as before (`agreement`), something moved during the batch, or the light
changed. From which pattern on, the pictures of the batch show. With y such a picture on the projector's
pixels, w white and P the pattern, by least squares

    y / w = s P + d . grad P + c

c being indirect light: P and its slopes, blurred, and a plane. d is how far things moved. What c does not fit
biases d, so that only its change within a batch counts.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy.ndimage

from ltcl.acquisition.agreement import Deviation, Sensor, find_deviation, spread
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.radiometry import Radiance

_DARK = 0.1  # of the median of white: pixels below are left out
_MODEL, _OWN = 0.02, 0.1  # relative errors of the model: of white, and of the light of P
_NEAR, _WIDE = 1.5, 4.0  # projector pixels that indirect light spreads over
_EXPECTED = 2  # pictures that a level which is expected counts as


def pattern(grid: tuple[int, int]) -> np.ndarray:
    """Codes (h, w): blocks of 2 x 2 pixels, on or off at random.

    >>> pattern((4, 4)).tolist()
    [[0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0]]
    """
    coarse = np.random.default_rng(0).random((-(-grid[0] // 2), -(-grid[1] // 2))) < 0.5
    return np.kron(coarse, np.ones((2, 2)))[: grid[0], : grid[1]].astype(np.float32)


def marked(batch: Sequence[np.ndarray]) -> np.ndarray:
    """The pattern for a batch of codes: a random half of its pixels, drawn by their hash, is 1 / 255 off.

    So it has another entry for each batch in a list of photographs, also after a scan was interrupted.
    """
    codes, digest = pattern(batch[0].shape[:2]), 0
    for one in batch:
        digest = zlib.crc32(np.ascontiguousarray(one).tobytes(), digest)
    mark = np.random.default_rng(digest).random(codes.shape) < 0.5
    return np.abs(codes - mark.astype(np.float32) / np.float32(255.0))


@dataclass(frozen=True, repr=False, eq=False)
class Anchor:
    """What a calibration saw of the pattern.

    Attributes
    ----------
    pixels : (n,) int
        Of the photograph, row by row: those that see the projector, or some of them.
    value, variance : (n, c)
        Radiance there, ambient light included.
    shift : (2,)
        d along x and y.
    """

    pixels: np.ndarray
    value: np.ndarray
    variance: np.ndarray
    shift: np.ndarray

    @classmethod
    def of(cls, shown: Radiance, white: Radiance, ambient: Radiance, R: Resampling) -> Self:
        """From pictures (H, W[, c]) under the pattern, of white less black, and under black."""
        size = shown.value.shape[0] * shown.value.shape[1]
        value, variance, valid = (p.reshape(size, -1) for p in (shown.value, shown.variance, shown.valid))
        seen = np.unique(R.weights.indices)
        pixels = spread(seen[valid[seen].all(axis=1)])
        shift = shift_of(pattern(R.grid), shown, white, ambient, R)
        return cls(pixels, value[pixels], variance[pixels], shift)

    def deviation(self, image: np.ndarray, seconds: float, sensor: Sensor) -> Deviation | None:
        """Whether a photograph (H, W[, c]) of the pattern deviates from that of the calibration."""
        known = Radiance(self.value, self.variance, np.ones(self.value.shape, bool))
        part = image.reshape(-1, 1, *image.shape[2:])[self.pixels]
        return find_deviation([part], [seconds], sensor, known=known)


def shift_of(
    codes: np.ndarray, picture: Radiance, white: Radiance, ambient: Radiance, R: Resampling
) -> np.ndarray:
    """d along x and y, in projector pixels, of a picture (H, W[, c]) under codes (h, w[, c])."""
    P = (codes if codes.ndim == 2 else codes.mean(axis=2)).astype(np.float64)
    light, w, dark = (
        R.apply(np.where(p.valid, p.value, 0.0)).reshape(*P.shape, -1).sum(axis=2)
        for p in (picture, white, ambient)
    )
    known = w > _DARK * np.median(w[w > 0]) if (w > 0).any() else w > 0
    r = np.where(known, (light - dark) / np.where(known, w, 1.0), 0.0)
    near, wide = (scipy.ndimage.gaussian_filter(P, width, mode="constant") for width in (_NEAR, _WIDE))
    y, x = np.indices(P.shape)
    terms = [*_slopes(P), P, near, wide, *_slopes(near), np.ones(P.shape), x, y]
    sigma = np.hypot(_MODEL, _OWN * scipy.ndimage.maximum_filter(P, 3, mode="constant"))[known]
    A = np.stack([term[known] for term in terms], axis=1) / sigma[:, None]
    d = np.linalg.lstsq(A, r[known] / sigma)[0][:2]
    return d / max(float(np.sum(r * P) / max(P.sum(), 1e-9)), 1e-3)


def _slopes(image: np.ndarray) -> list[np.ndarray]:
    """Central differences along x and y, the image being 0 outside."""
    return [scipy.ndimage.correlate1d(image, [-0.5, 0.0, 0.5], axis, mode="constant") for axis in (1, 0)]


def first_moved(shifts: Sequence[np.ndarray], moved: np.ndarray) -> int:
    """The first of pictures from which on they are moved, by robust least deviations; their number: none.

    >>> d = [np.array([x, 0.0]) for x in (0.02, -0.03, 0.2, 0.1, 0.1)]
    >>> first_moved(d, np.array([0.12, 0.0]))
    2
    """
    along = np.array([moved @ d for d in shifts]) / max(moved @ moved, 1e-12)
    misfit = []
    for first in range(len(shifts) + 1):
        parts = along[:first], along[first:]
        levels = [np.median([*part, *[expected] * _EXPECTED]) for expected, part in enumerate(parts)]
        misfit.append(sum(np.sqrt(abs(p - level)).sum() for p, level in zip(parts, levels, strict=True)))
    return int(np.argmin(misfit))
