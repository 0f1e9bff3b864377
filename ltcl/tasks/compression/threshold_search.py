# SPDX-License-Identifier: BSD-3-Clause
"""`ThresholdSearch` for the largest norm that may be dropped, apart from what it measures."""

from __future__ import annotations

import math

# Part of the tolerance that is tried next, and part from which on a result is close enough.
AIMED_SHARE = 0.96
CLOSE_SHARE = 0.92
# No step grows by more.
MAX_GROWTH = 8.0
# Bounds that are this near end the search.
BRACKET_RATIO = 1.05


class ThresholdSearch:
    """Bracket of the Frobenius norm `drop`, whose error grows with it.

    Attributes
    ----------
    drop : float
        Norm that is tried.
    accepted, rejected : float
        Largest norm whose error was within the tolerance, 0 if none; smallest one beyond it.
    """

    def __init__(self, drop: float) -> None:
        self.drop = drop
        self.accepted = 0.0
        self.rejected = math.inf
        self._rejections = 0

    def accept(self) -> None:
        """Note that the error is within the tolerance."""
        self.accepted = self.drop

    def reject(self) -> None:
        """Note that the error is beyond the tolerance, and that less can be dropped."""
        self.rejected = self.drop
        self._rejections += 1

    def is_close(self, share: float) -> bool:
        """True if a share of the tolerance is as good as all of it."""
        return share >= CLOSE_SHARE

    def advance(self, share: float, widest: float) -> bool:
        """Choose the next norm, after an error of this share of the tolerance.

        `widest` is about what may be dropped at most. False where the bracket has become narrow.
        """
        self.drop *= self._growth(share)
        if not self.accepted < self.drop < self.rejected:
            self.drop = self._inside(widest)
        return self.rejected >= BRACKET_RATIO * self.accepted

    def _growth(self, share: float) -> float:
        # How far the error lies below the norm changes slowly: in proportion, a little short. Where
        # that misses again, rounding is most of the error, and leaves less for what is dropped.
        if share == 0.0:
            return MAX_GROWTH
        misses_in_a_row = max(self._rejections - 1, 0)
        return min(AIMED_SHARE / share / 2.0**misses_in_a_row, MAX_GROWTH)

    def _inside(self, widest: float) -> float:
        """A norm within the bracket, or beyond its only end."""
        if self.accepted and math.isfinite(self.rejected):
            return math.sqrt(self.accepted * self.rejected)
        if self.accepted:
            return 2.0 * self.accepted
        return 0.5 * min(self.rejected, widest)
