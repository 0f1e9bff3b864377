# SPDX-License-Identifier: BSD-3-Clause
"""The weights of Chebyshev's iteration one by one, for iterates that are matrices.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1.
"""

from __future__ import annotations

from collections.abc import Iterator


class Chebyshev(Iterator[tuple[float, float]]):
    """Weights (alpha, beta) of the steps: alpha G + beta times what was added last, is added next.

    >>> steps = Chebyshev((0.5, 1.5))
    >>> next(steps), steps.shrinks  # the residual is 1 / T_1(2) of what it was
    ((1.0, 0.0), 0.5)
    >>> [round(weight, 3) for weight in next(steps)], round(steps.shrinks, 3)  # 1 / T_2(2) = 1 / 7
    ([1.143, 0.143], 0.286)
    """

    def __init__(self, bounds: tuple[float, float]) -> None:
        lower, upper = bounds
        self.centre, self.radius = (upper + lower) / 2.0, (upper - lower) / 2.0
        self._rho: float | None = None

    @property
    def shrinks(self) -> float:
        """What the last step left of the residual, in theory."""
        return self._rho or 0.0

    def __next__(self) -> tuple[float, float]:
        share = self.radius / self.centre  # 1 / sigma
        if self._rho is None or share == 0.0:
            self._rho = share  # 2.
            return 1.0 / self.centre, 0.0
        previous, self._rho = self._rho, share / (2.0 - share * self._rho)  # 6.
        return 2.0 * self._rho / self.radius, self._rho * previous  # 7.
