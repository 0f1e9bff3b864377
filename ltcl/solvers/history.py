# SPDX-License-Identifier: BSD-3-Clause
"""Residuals that wait on the device until several are read at once.

Waiting for one number after every product leaves a device idle between products. So norms are queued like
everything else, and the best iterate is kept by the device itself.
"""

from __future__ import annotations

import numpy as np

from ltcl.device import Array, vectors

SLOTS = 8  # residuals that may wait
_TIE = 1.0 + 2.0**-20  # squares as far apart are equal up to rounding


class History:
    """Up to `SLOTS` residuals of k columns; `scale` (k,) are what the norms of each count in."""

    def __init__(self, b: Array, scale: np.ndarray) -> None:
        self._squares = b.device.empty((SLOTS, b.columns))
        self._weights = b.device.upload(scale**-2.0)
        self.waiting = 0

    def queue(self, x: Array, r: Array, lowest: float, best: Array) -> None:
        """Measure the residual `r` of `x`, which becomes `best` where none is lower; does not wait."""
        vectors.queue_dot(r, r, self._squares, self.waiting)
        vectors.keep(self._weights, self._squares, self.waiting, lowest**2 * _TIE, x, best)
        self.waiting += 1

    def read(self, r: Array) -> np.ndarray:
        """Norms (waiting + 1, k) of those queued and of `r`; waits for the device, once."""
        if not self.waiting:
            return vectors.norm(r)[None]
        vectors.queue_dot(r, r, self._squares, self.waiting)
        squares = self._squares.get()[: self.waiting + 1]
        self.waiting = 0
        return np.sqrt(squares.astype(np.float64))
