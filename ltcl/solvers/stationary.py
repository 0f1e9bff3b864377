# SPDX-License-Identifier: BSD-3-Clause
"""Stationary iterations, Jacobi, the Neumann series, Richardson; and Chebyshev's, which shares their loop.

One launch a step (`Operator.stepper`), with x the iterate and r its residual:

    x += d,   r -= S d,   d = keep d + gain r

Jacobi (eq. 20), keep = 0 and gain = 1: what the projector must still add is what the last guess lacks,
l^(k+1) = l^(k) + (l_out - S l^(k)). Started from zero, k steps are the k-term inverse Neumann series
(eq. 10), whose next term is the residual; the forward dual (eq. 18) is the same on I - A. Both converge
where the spectral radius of R is below 1.

Richardson, gain = omega: damping makes it converge for every albedo below one. On a spectrum in [a, b] the
best omega is 2 / (a + b), with the factor (b - a) / (b + a) a step (Saad, Iterative Methods for Sparse Linear
Systems, 2nd ed., example 4.1).

Chebyshev (Saad, algorithm 12.1, whose numbers are in comments): the best polynomial in S for a spectrum in an
interval, of a Lambertian scene the free bounds (`theory.free_bounds`). Not for spectra with large imaginary
parts, nor with eigenvalues on both sides of 0: the monitor sees residuals grow. A few steps of GMRES at the
start draw the bounds in. Where they leave out eigenvalues, the residual grows by their eigenvectors: more
steps of GMRES take those out and show their eigenvalues, the bounds are widened, and the iteration goes on.
"""

from __future__ import annotations

import itertools
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
from ltcl.solvers.stopping import SLOTS, Monitor, System

_GROWTH = 10.0  # times what a residual should be in theory: above what weights of surfaces may do to norms
_SEEN = 1e-4  # relative residual down to which bounds are judged: below, rounding has its part in it
_REPAIRS = 3  # times that bounds are widened before the monitor alone decides
_REPAIR_STEPS = 5
_FIRST_STEPS = 2
_DEEPER = 4.0  # what a lower bound that failed is divided by: small eigenvalues are found last
_MARGIN = 0.25  # of the width of the Ritz values, added on both sides: the outermost are not found at once
_SAFETY = 1.05


def steps(
    system: System, x: Array, r: Array, monitor: Monitor, coefficients: Iterator[tuple[float, float]]
) -> Iterator[None]:
    """Take steps with (keep, gain), the first for d = gain r alone, until the monitor ends it.

    Yields after each reading of residuals that does not end the solve.
    """
    stepper = system.S.stepper(x, r, SLOTS)
    keep, gain = next(coefficients)
    stepper.start(gain)
    length = abs(gain) * monitor.norms  # of d, at most
    while True:
        queued = list(itertools.islice(coefficients, monitor.steps_ahead()))
        for keep, gain in queued:
            stepper.step(keep, gain)
        system.products += len(queued)
        norms, travelled = stepper.norms(), np.zeros_like(length)
        for (keep, gain), norm in zip(queued, norms, strict=True):
            travelled += length
            length = abs(keep) * length + abs(gain) * norm
        if monitor.check(x, r, norms, travelled):
            return
        yield


@dataclass(frozen=True)
class Jacobi:
    """No options."""

    name: ClassVar[str] = "jacobi"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        for _ in steps(system, x, r, monitor, itertools.repeat((0.0, self._damping(system.S)))):
            pass

    def _damping(self, S: Operator) -> float:
        return 1.0


@dataclass(frozen=True)
class Neumann(Jacobi):
    """The series is Jacobi's iteration started from zero; no options."""

    name: ClassVar[str] = "neumann"


@dataclass(frozen=True)
class Richardson(Jacobi):
    """Options: ``omega``, the damping; the best one for the free bounds of S when not given."""

    name: ClassVar[str] = "richardson"
    omega: float | None = None

    def __post_init__(self) -> None:
        if self.omega is not None:
            checks.number("omega", self.omega, above=0.0)

    def _damping(self, S: Operator) -> float:
        if self.omega is not None:
            return float(self.omega)
        lower, upper = theory.free_bounds(S)
        # Row sums that leave float32 tell nothing; a first step without damping shows that S does, too.
        return 2.0 / (lower + upper) if math.isfinite(upper) else 1.0


def chebyshev_steps(lower: float, upper: float) -> Iterator[tuple[float, float]]:
    """(keep, gain) of one step after the other, for a spectrum of S in [lower, upper], 0 < lower.

    With lower = upper it is Richardson's iteration, with both 1 the Neumann series.

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
    """What a step leaves of a residual at last, sigma - sqrt(sigma^2 - 1), sigma = centre / radius."""
    share = (upper - lower) / (upper + lower)  # 1 / sigma
    return share / (1.0 + math.sqrt(1.0 - share**2))


@dataclass(frozen=True)
class Chebyshev:
    """Options: ``spectrum`` of S, and ``arnoldi``, steps of GMRES to begin with, which refine it."""

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
        S, bounds = system.S, self.spectrum or theory.free_bounds(system.S)
        first = self.arnoldi if self.arnoldi is not None else 0 if self.spectrum else _FIRST_STEPS
        if first:
            space = gmres.cycle(system, x, r, monitor, first)
            bounds = drawn_in(bounds, S, space.ritz_values())
        for growth in (*[_GROWTH] * _REPAIRS, math.inf):
            if monitor.status is not None or not _run(system, x, r, monitor, bounds, growth):
                return
            # What has grown are the eigenvectors that the bounds leave out; few steps find their eigenvalues.
            space = gmres.cycle(system, x, r, monitor, _REPAIR_STEPS)
            lower, upper = _hull(_hull(bounds, theory.free_bounds(S)), _positive(space.ritz_values()))
            bounds = lower / _DEEPER, upper


def drawn_in(bounds: tuple[float, float], S: Operator, ritz: np.ndarray) -> tuple[float, float]:
    """Bounds drawn in to a quarter of the width of the Ritz values around these, and out to hold them.

    With them <1, S 1> / <1, 1> in the inner product of `S.weights`: near the eigenvalue that dominates R, of
    which a picture may have hardly any part.
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
    """Bounds drawn out, where they have to be, to hold the values and a little more."""
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
