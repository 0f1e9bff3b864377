# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev iteration: the best polynomial in S for a spectrum known to lie in an interval.

Where the paper's series needs rho(R) < 1, this converges for every albedo below one: of a Lambertian scene
the spectrum of S lies in [1/2, 1 + max row sum of R], which costs nothing to know (`theory.free_bounds`).
No inner products after the start, so nothing is read back but the residual, every few products. Not for
spectra with large imaginary parts, nor with eigenvalues on both sides of 0: the monitor sees residuals grow.

A few steps of GMRES at the start, `arnoldi` of them, draw the bounds in (`drawn_in`), and solve as well as
they measure. Where bounds leave out eigenvalues, the residual grows by their eigenvectors: more steps of
GMRES take those out and show their eigenvalues, the bounds are widened, and the iteration goes on.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1.
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
from ltcl.solvers import gmres
from ltcl.solvers.stationary import steps
from ltcl.solvers.stopping import Monitor, System

_GROWTH = 10.0  # times what a residual should be in theory: above what weights of surfaces may do to norms
_SEEN = 1e-4  # relative residual down to which bounds are judged: below, rounding has its part in it
_REPAIRS = 3  # times that bounds are widened before the monitor alone decides
_REPAIR_STEPS = 5
_FIRST_STEPS = 2
_DEEPER = 4.0  # what a lower bound that failed is divided by: small eigenvalues are found last
_MARGIN = 0.25  # of the width of the Ritz values, added on both sides: the outermost are not found at once
_SAFETY = 1.05


def chebyshev_steps(lower: float, upper: float) -> Iterator[tuple[float, float]]:
    """(keep, gain) of one step after the other, for a spectrum of S in [lower, upper], 0 < lower.

    The first keep is 0. With lower = upper it is Richardson's iteration, with both 1 the Neumann series.

    >>> steps = chebyshev_steps(0.5, 1.5)
    >>> next(steps), [round(number, 3) for number in next(steps)]
    ((0.0, 1.0), [0.143, 1.143])
    """
    centre, radius = (upper + lower) / 2.0, (upper - lower) / 2.0
    gain, rho = 1.0 / centre, radius / centre  # 2.
    yield 0.0, gain
    while True:
        gain = 2.0 / (2.0 * centre - radius * rho)
        previous, rho = rho, radius * gain / 2.0  # 6.
        yield previous * rho, gain  # 7.


def chebyshev_rate(lower: float, upper: float) -> float:
    """What a step leaves of a residual in the long run, sigma - sqrt(sigma^2 - 1), sigma = centre / radius.

    >>> chebyshev_rate(1.0, 1.0), round(chebyshev_rate(0.5, 1.5), 3)
    (0.0, 0.268)
    """
    share = (upper - lower) / (upper + lower)  # 1 / sigma
    return share / (1.0 + math.sqrt(1.0 - share**2))


@dataclass(frozen=True)
class Chebyshev:
    """Options of chebyshev.

    Attributes
    ----------
    spectrum : (lower, upper), optional
        Between which the spectrum of S lies; the free bounds when not given.
    arnoldi : int
        Steps of GMRES to begin with, at least 2, whose Ritz values refine the bounds; 0 for none. When not
        given, 2 with the free bounds, which they about halve the products of, and 0 with a `spectrum`.
    """

    name: ClassVar[str] = "chebyshev"
    spectrum: tuple[float, float] | None = None
    arnoldi: int | None = None

    def __post_init__(self) -> None:
        if self.arnoldi is not None and checks.count("arnoldi", self.arnoldi, least=0) == 1:
            raise InputError("arnoldi is 1; it must be 0 or at least 2, since one step tells no width")
        if self.spectrum is None:
            return
        try:
            lower, upper = self.spectrum
        except (TypeError, ValueError):
            raise InputError(f"spectrum is {self.spectrum!r}; it must be (lower, upper)") from None
        checks.number("spectrum[1]", upper, least=checks.number("spectrum[0]", lower, above=0.0))

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if monitor.check(x, r, system.start_norms):
            return
        bounds = self.spectrum or theory.free_bounds(system.S)
        first = self.arnoldi if self.arnoldi is not None else 0 if self.spectrum else _FIRST_STEPS
        if first:
            _, learnt = gmres.cycle(system, x, r, monitor, first)
            if monitor.check(x, r):
                return
            bounds = drawn_in(bounds, system.S, learnt.ritz_values())
        for _ in range(_REPAIRS):
            if not _run(system, x, r, monitor, bounds, _GROWTH):
                return
            # What has grown are the eigenvectors that the bounds leave out; few steps find their eigenvalues.
            _, learnt = gmres.cycle(system, x, r, monitor, _REPAIR_STEPS)
            if monitor.check(x, r):
                return
            lower, upper = _hull(_hull(bounds, theory.free_bounds(system.S)), _positive(learnt.ritz_values()))
            bounds = lower / _DEEPER, upper
        _run(system, x, r, monitor, bounds, math.inf)


def drawn_in(bounds: tuple[float, float], S: Operator, ritz: np.ndarray) -> tuple[float, float]:
    """Bounds drawn in to a quarter of the width of the Ritz values around these, and out to hold them.

    To the Ritz values, real parts above 0, comes <1, S 1> / <1, 1>, from the row sums and in the inner
    product of `S.weights`: near the eigenvalue that dominates R, of which a picture may have hardly any part.
    """
    seen = _positive(np.append(ritz, theory.row_sum_range(S)[1]))
    if len(ritz) < 2 or not len(seen):
        return _hull(bounds, seen)
    margin = _MARGIN * float(np.max(seen) - np.min(seen))
    lower, upper = max(bounds[0], float(np.min(seen)) - margin), min(bounds[1], float(np.max(seen)) + margin)
    return _hull((lower, upper) if lower < upper else bounds, seen)


def _positive(ritz: np.ndarray) -> np.ndarray:
    real = np.real(ritz)
    return real[(real > 0.0) & np.isfinite(real)]


def _hull(bounds: tuple[float, float], values: Any) -> tuple[float, float]:
    """Bounds drawn out, where they have to be, to hold the values and a little more.

    >>> _hull((0.5, 1.0), [0.75, 4.0])
    (0.5, 4.2)
    """
    lower, upper = bounds
    least, most = float(np.min(values, initial=lower)), float(np.max(values, initial=upper))
    return lower if least >= lower else least / _SAFETY, upper if most <= upper else most * _SAFETY


def _run(
    system: System, x: Array, r: Array, monitor: Monitor, bounds: tuple[float, float], growth: float
) -> bool:
    """Iterate to the end, or until the residual is so many times what theory has it: then True."""
    start, first = monitor.iterations, max(monitor.residuals[-1], monitor.lowest)
    monitor.factor = chebyshev_rate(*bounds)
    for _ in steps(system, x, r, monitor, chebyshev_steps(*bounds)):
        left = monitor.factor ** (monitor.iterations - start)
        theirs = first * 2.0 * left / (1.0 + left**2)  # 1 / T_k(sigma) of the first, in theory
        if monitor.residuals[-1] > max(growth * theirs, _SEEN):
            return True
    return math.isfinite(growth) and monitor.resume(x, r)
