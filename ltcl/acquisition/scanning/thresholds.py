# SPDX-License-Identifier: BSD-3-Clause
"""Which entries of a column of T are light, and which are noise of the sensor: sums are tested.

An entry far above its noise is kept. Of what is left, all entries of a tile of 4 x 4 camera pixels are kept
where their sum is far from 0 for its noise, then of 16 x 16, and so on to the whole picture; then the same
over all columns of the batch. So a weak bounce, each entry of which is below its noise, stays as a whole, and
what is dropped sums to nothing that the camera could tell. Both signs are kept alike: no bias.
"""

from __future__ import annotations

import numpy as np

from ltcl import checks
from ltcl.acquisition.scanning.cells import Blocks
from ltcl.acquisition.scanning.pictures import UNKNOWN

_STEP = 4  # sides of tiles, from one to the next


def keep(value: np.ndarray, variance: np.ndarray, grid: tuple[int, int], sigmas: float = 3.0) -> np.ndarray:
    """Which entries (k, M) of k columns to keep.

    Parameters
    ----------
    value, variance : (k, M)
        Entries of unknown variance are kept.
    grid : (h, w)
        Of the M pixels.
    sigmas : float
        Standard deviations that are far; 0 keeps everything.

    Examples
    --------
    Light of one standard deviation in each entry of a column, and none in the other:

    >>> noise = np.random.default_rng(0).normal(size=(2, 64))
    >>> keep(noise + np.array([[1.0], [0.0]]), np.ones((2, 64)), (8, 8)).mean(axis=1)
    array([1., 0.])
    """
    checks.number("sigmas", sigmas, least=0.0)
    kept = np.asarray(variance) >= 1e-3 * UNKNOWN
    if sigmas == 0.0:
        return np.ones_like(kept)
    kept |= value**2 > sigmas**2 * variance
    for together in (False, True):
        for side in _sides(grid):
            kept |= _far(value, variance, ~kept, Blocks(grid, side), sigmas, together)
    return kept


def _sides(grid: tuple[int, int]) -> list[int]:
    """4, 16, ... and the longer side of the grid."""
    most = max(grid)
    found, side = [], _STEP
    while side < most:
        found.append(side)
        side *= _STEP
    return [*found, most]


def _far(
    value: np.ndarray, variance: np.ndarray, left: np.ndarray, tiles: Blocks, sigmas: float, together: bool
) -> np.ndarray:
    """Of the entries left, those in tiles whose sum is far from 0."""
    total, noise = (_sums(np.where(left, part, 0.0), tiles, together) for part in (value, variance))
    far = (total**2 > sigmas**2 * noise).astype(np.float32)
    spread = np.moveaxis(tiles.enlarged(far), -1, 0).reshape(far.shape[-1], -1) > 0
    return left & spread


def _sums(part: np.ndarray, tiles: Blocks, together: bool) -> np.ndarray:
    """(tiles of a column, tiles of a row, columns or 1)."""
    pictures = part.sum(axis=0, keepdims=True) if together else part
    return tiles.sum(np.moveaxis(pictures.reshape(-1, *tiles.pixels), 0, -1))
