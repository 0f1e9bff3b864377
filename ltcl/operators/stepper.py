# SPDX-License-Identifier: BSD-3-Clause
"""Steps of a stationary iteration, x += d; r -= S d; d = keep d + gain r, on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators.epilogue import Epilogue

if TYPE_CHECKING:
    from ltcl.operators.base import Operator


class Stepper:
    """Steps of a stationary iteration on S = a A + c I: x += d; r -= S d; d = keep d + gain r.

    With keep = 0 they are Jacobi's (gain 1, eq. 20) or Richardson's; with the right numbers
    Chebyshev's. `waiting` counts the steps whose norms have not been read yet.
    """

    def __init__(self, A: Operator, x: Array, r: Array, slots: int, a: float, c: float) -> None:
        self.A = A
        self.x = x
        self.r = r
        self.slots = slots
        self.d = x.like()
        self.spare = x.like()
        self.waiting = 0
        self._a = a
        self._c = c
        self._prepare()

    def _prepare(self) -> None:
        groups = vectors.step_groups(self.x)
        # Sums of squares of residuals, (slots, groups, k).
        self._partials = self.A.device.empty((self.slots, groups, self.x.columns))
        self._multiply = self.A.bind(self.d, self.spare, Epilogue(a=self._a, c=self._c))

    def start(self, gain: float) -> None:
        """Queue d = gain r, the first direction."""
        vectors.axpby(gain, self.r, 0.0, self.r, self.d)

    def step(self, keep: float, gain: float) -> None:
        """Queue one step: x moves along d, and the next d is keep d + gain r with the new r."""
        self._multiply()
        vectors.queue_step(
            self.spare, self.x, self.r, self.d, keep, gain, self._partials, self.waiting
        )
        self.waiting += 1

    def finish(self) -> None:
        """Leave the steps in `x` and `r`, and forget the norms that wait; does not wait."""
        self.waiting = 0

    def norms(self) -> np.ndarray:
        """Norms (waiting, k) float64 of the residuals since the last call, newest last.

        Waits for the device once.
        """
        squares = self.A.device.empty((self.slots, self.x.columns))
        vectors.queue_sum_partials(self._partials, self.waiting, squares)
        new_squares = squares.get()[: self.waiting]
        self.waiting = 0
        return np.sqrt(new_squares.astype(np.float64))
