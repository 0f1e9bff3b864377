# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev's iteration: the best polynomial in S for a spectrum in an interval [a, b], 0 < a.

Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1, whose numbers are in
comments. The interval is the free bounds, tightened by a few steps of GMRES. If they leave out
eigenvalues, the residual grows: more steps of GMRES find these, and the iteration goes on with
wider bounds.

Limits: spectra with large imaginary parts, or with eigenvalues on both sides of 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators import Operator
from ltcl.solvers.krylov_space import krylov_cycle
from ltcl.solvers.method import IterativeMethod
from ltcl.solvers.stationary import take_steps
from ltcl.solvers.stopping import CountedOperator, Monitor


@dataclass(frozen=True, kw_only=True)
class BoundsSearch:
    """Parameters by which bounds on the spectrum are tightened, judged and repaired."""

    # Steps of GMRES before the iteration, and of each repair.
    first_steps: int = 2
    repair_steps: int = 5
    # Times that bounds are widened before the monitor alone decides.
    repairs: int = 3
    # A residual of so many times the theoretical one has grown; weights of surfaces may do less to
    # norms.
    growth_limit: float = 10.0
    # Bounds are judged down to this relative residual: below, rounding has its part in it.
    rounding_floor: float = 1e-4
    # A lower bound that failed is divided by this: small eigenvalues are found last.
    lower_bound_reduction: float = 4.0
    # Share of the width of the Ritz values that is added on both sides: the outermost eigenvalues
    # are not found at once.
    margin: float = 0.25
    # Factor by which bounds are moved beyond a value that they did not contain.
    safety: float = 1.05


SEARCH = BoundsSearch()
Bounds = tuple[float, float]


def chebyshev_steps(lower: float, upper: float) -> Iterator[tuple[float, float]]:
    """Return (keep, gain) of one step after the other, for a spectrum in [lower, upper], 0 < lower.

    With lower = upper it is Richardson's iteration, with both 1 the Neumann series.

    >>> steps = chebyshev_steps(0.5, 1.5)
    >>> next(steps), [round(number, 3) for number in next(steps)]
    ((0.0, 1.0), [0.143, 1.143])
    """
    center = (upper + lower) / 2.0
    radius = (upper - lower) / 2.0
    # 2. rho_0 = 1 / sigma_1, and the first direction r / theta.
    gain = 1.0 / center
    rho = radius / center
    yield 0.0, gain
    while True:
        # 6. The next rho.
        gain = 2.0 / (2.0 * center - radius * rho)
        previous_rho = rho
        rho = radius * gain / 2.0
        # 7. The next direction.
        yield previous_rho * rho, gain


def chebyshev_rate(lower: float, upper: float) -> float:
    """Return the factor by which late steps reduce a residual.

    sigma - sqrt(sigma^2 - 1) with sigma = centre / radius of the interval.
    """
    inverse_sigma = (upper - lower) / (upper + lower)
    return inverse_sigma / (1.0 + math.sqrt(1.0 - inverse_sigma**2))


@dataclass(frozen=True)
class Chebyshev(IterativeMethod):
    """Chebyshev's iteration.

    Options: ``spectrum``, bounds on that of S, and ``arnoldi``, steps of GMRES to begin with, which
    refine the bounds.
    """

    name: ClassVar[str] = "chebyshev"
    spectrum: Bounds | None = None
    arnoldi: int | None = None

    def __post_init__(self) -> None:
        if self.arnoldi is not None and checks.count("arnoldi", self.arnoldi, least=0) == 1:
            raise InputError(
                "arnoldi is 1; it must be 0 or at least 2, since one step tells no width"
            )
        if self.spectrum is None:
            return
        try:
            lower, upper = self.spectrum
        except (TypeError, ValueError):
            raise InputError(f"spectrum is {self.spectrum!r}; it must be (lower, upper)") from None
        lower = checks.number("spectrum[0]", lower, above=0.0)
        checks.number("spectrum[1]", upper, least=lower)

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        S = system.S
        bounds = self.spectrum
        if bounds is None:
            bounds = theory.free_bounds(S)
        first_steps = self._first_steps()
        if first_steps:
            space = krylov_cycle(system, x, r, monitor, first_steps)
            bounds = tighten_bounds(bounds, S, space.ritz_values())

        for _ in range(SEARCH.repairs):
            if monitor.status is not None:
                return
            has_grown = self._iterate_within(bounds, SEARCH.growth_limit, system, x, r, monitor)
            if not has_grown and not monitor.resume(x, r):
                return
            # What has grown are the eigenvectors that the bounds leave out; few steps of GMRES find
            # their eigenvalues.
            space = krylov_cycle(system, x, r, monitor, SEARCH.repair_steps)
            bounds = _repaired_bounds(bounds, S, space.ritz_values())
        if monitor.status is None:
            self._iterate_within(bounds, math.inf, system, x, r, monitor)

    def _first_steps(self) -> int:
        if self.arnoldi is not None:
            return self.arnoldi
        return SEARCH.first_steps if self.spectrum is None else 0

    @staticmethod
    def _iterate_within(
        bounds: Bounds,
        limit: float,
        system: CountedOperator,
        x: Array,
        r: Array,
        monitor: Monitor,
    ) -> bool:
        """Iterate with these bounds; return whether residuals grew beyond `limit` times theory."""
        start = monitor.iterations
        initial = max(monitor.residuals[-1], monitor.lowest)
        monitor.factor = chebyshev_rate(*bounds)
        for _ in take_steps(system, x, r, monitor, chebyshev_steps(*bounds)):
            # 1 / T_k(sigma) of the first residual, with the rate^k of k steps.
            rate = monitor.factor ** (monitor.iterations - start)
            expected = initial * 2.0 * rate / (1.0 + rate**2)
            if monitor.residuals[-1] > max(limit * expected, SEARCH.rounding_floor):
                return True
        return False


def tighten_bounds(bounds: Bounds, S: Operator, ritz: np.ndarray) -> Bounds:
    """Tighten bounds to the Ritz values and a quarter of their width, and widen them to hold these.

    The mean row sum counts as one of them: it is near the eigenvalue that dominates R, which a
    picture may have no part of.
    """
    values = _positive_parts(np.append(ritz, S.row_sum_range().mean))
    if len(ritz) < 2 or not len(values):
        return _widen(bounds, values)
    lowest = float(np.min(values))
    highest = float(np.max(values))
    margin = SEARCH.margin * (highest - lowest)
    lower = max(bounds[0], lowest - margin)
    upper = min(bounds[1], highest + margin)
    tightened = (lower, upper) if lower < upper else bounds
    return _widen(tightened, values)


def _repaired_bounds(bounds: Bounds, S: Operator, ritz: np.ndarray) -> Bounds:
    """Widen bounds that have failed, to hold the Ritz values and the free bounds."""
    values = np.append(_positive_parts(ritz), theory.free_bounds(S))
    lower, upper = _widen(bounds, values)
    return lower / SEARCH.lower_bound_reduction, upper


def _positive_parts(ritz: np.ndarray) -> np.ndarray:
    """Return the real parts that are positive and finite."""
    real = np.real(ritz)
    return real[(real > 0.0) & np.isfinite(real)]


def _widen(bounds: Bounds, values: Any) -> Bounds:
    """Widen bounds, where they have to be, to hold the values and a little more."""
    lower, upper = bounds
    lowest = float(np.min(values, initial=lower))
    highest = float(np.max(values, initial=upper))
    # A value that is not a number spoils the bounds, and the monitor ends the solve.
    if not lowest >= lower:
        lower = lowest / SEARCH.safety
    if not highest <= upper:
        upper = highest * SEARCH.safety
    return lower, upper


METHODS = (Chebyshev,)
