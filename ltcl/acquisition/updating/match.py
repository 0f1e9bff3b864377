# SPDX-License-Identifier: BSD-3-Clause
"""Rows of T that fail after an update, replaced by those old rows that explain their pictures.

Where one map does not tell how the projector has moved, as behind the edge of an object, at a
mirror, or where something was put into the scene, light of other pixels falls now. A pixel i sees
y_k under the patterns p_k; an old row c would see f_k = (T p_k)_c. The one that leaves least,

    min over c and g of  sum_k (y_k - g f_k)^2,    g = f . y / f . f >= 0

takes the place of row i, g times as bright, if it leaves far less than row i itself does: its
direct light falls where that of row i falls now, and far light varies slowly. What it leaves is
corrected by a change of functions around c (`change`). Patterns at random tell some hundred
thousand rows apart, as no two places see the same of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ltcl.acquisition.updating.warp import HostTransport

# What another row leaves of the pictures of a pixel, relative to what its own row does, at most.
MAX_LEFT_RATIO = 0.5
# Correlations at once.
CHUNK_NUMBERS = 1 << 22
TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False, kw_only=True)
class Matches:
    """Rows of T that take the place of others.

    Attributes
    ----------
    centres : (N,)
        The row that takes the place of each; its own number where it stays.
    gain : (N, channels)
        How much brighter it is then; 1 of rows that were not to be matched.
    """

    centres: np.ndarray
    gain: np.ndarray

    @property
    def moved(self) -> np.ndarray:
        """Rows (N,) that are replaced by others."""
        return self.centres != np.arange(len(self.centres))

    def apply(self, T: HostTransport) -> HostTransport:
        """T with the rows that take the place of others."""
        cores = []
        for channel, core in enumerate(T.cores):
            scale = scipy.sparse.diags_array(self.gain[:, channel])
            cores.append(scipy.sparse.csr_array(scale @ core[self.centres]))
        return HostTransport(grid=T.grid, cores=cores, W=T.W)


def match_rows(
    T: HostTransport, patterns: np.ndarray, pictures: np.ndarray, chosen: np.ndarray
) -> Matches:
    """Match rows of numbers `chosen` with pictures (k, N, channels) of patterns (k, N)."""
    foretold = T.products(patterns)
    pixels, channels = foretold.shape[1:]
    energy = np.maximum((foretold**2).sum(axis=0), TINY)
    centres = np.arange(pixels)
    gain = np.ones((pixels, channels))
    for rows in _chunks(chosen, pixels):
        residual = np.zeros((len(rows), pixels))
        gains = np.zeros((channels, len(rows), pixels))
        for channel in range(channels):
            seen = pictures[:, rows, channel]
            products = np.maximum(seen.T @ foretold[:, :, channel], 0.0)
            gains[channel] = products / energy[:, channel]
            residual += (seen**2).sum(axis=0)[:, None] - products * gains[channel]
        numbers = np.arange(len(rows))
        best = residual.argmin(axis=1)
        is_better = residual[numbers, best] < MAX_LEFT_RATIO * residual[numbers, rows]
        best = np.where(is_better, best, rows)
        centres[rows] = best
        gain[rows] = gains[:, numbers, best].T
    return Matches(centres=centres, gain=gain)


def _chunks(chosen: np.ndarray, pixels: int) -> Iterator[np.ndarray]:
    """Numbers of rows, as many at once as memory holds."""
    size = max(CHUNK_NUMBERS // pixels, 1)
    for start in range(0, len(chosen), size):
        yield chosen[start : start + size]
