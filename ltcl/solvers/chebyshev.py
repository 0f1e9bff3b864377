# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev iteration: the best polynomial in S for a spectrum known to lie in an interval.

Where the paper's series needs rho(R) < 1, this converges for every albedo below one: of a Lambertian scene
the spectrum of S lies in [1/2, 1 + max row sum of R], which costs nothing to know (`theory.free_bounds`).
No inner products after the start, so nothing is read back but the residual, every few products. Not for
spectra with large imaginary parts, nor with eigenvalues on both sides of 0: the monitor sees residuals grow.

Of other scenes the bounds may leave out eigenvalues, and then the residual grows by their eigenvectors, or
hardly falls. A few steps of GMRES take those out and tell their eigenvalues; the bounds are widened and the
iteration goes on.
The same steps at the start, `arnoldi` of them, draw the bounds in. They solve as well as they measure: in
boxes of rho(R) = 4 a solve to 1 % takes 4 products in place of 9, for a handful of inner products read back.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.solvers import gmres
from ltcl.solvers.stopping import Monitor, System
from ltcl.solvers.survey import even_quotient, refined, widened

_GROWTH = 10.0  # times what a residual should be in theory: above what weights of surfaces may do to norms
_SEEN = 1e-4  # relative residual down to which bounds are judged: below, rounding has its part in it
_REPAIRS = 3  # times that bounds are widened before the monitor alone decides
_REPAIR_STEPS = 5
_FIRST_STEPS = 2
_DEEPER = 4.0  # what the lower bound is divided by where eigenvalues lie below it


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
        if monitor.done(x, r):
            return
        bounds = self.spectrum or theory.free_bounds(system.S)
        steps = self.arnoldi if self.arnoldi is not None else 0 if self.spectrum else _FIRST_STEPS
        if steps:
            _, learnt = gmres.cycle(system, x, r, monitor, steps)
            if monitor.done(x, r):
                return
            bounds = refined(bounds, learnt.ritz_values(), even_quotient(system.S))
        for _ in range(_REPAIRS):
            if not _run(system, x, r, monitor, bounds, _GROWTH):
                return
            # What has grown are the eigenvectors that the bounds leave out; few steps find their eigenvalues.
            _, learnt = gmres.cycle(system, x, r, monitor, _REPAIR_STEPS)
            if monitor.done(x, r):
                return
            bounds = _outer(bounds, theory.free_bounds(system.S), learnt.ritz_values())
        _run(system, x, r, monitor, bounds, math.inf)


def _outer(bounds: tuple[float, float], free: tuple[float, float], ritz: np.ndarray) -> tuple[float, float]:
    """Bounds that failed, drawn out to the free ones and the Ritz values; where that changes nothing, by far.

    Small eigenvalues are found last and cost least to allow for, so the lower end goes down by factors.

    >>> _outer((0.8, 2.0), (0.5, 5.0), np.array([0.6, 2.5])), _outer((0.5, 5.0), (0.5, 5.0), np.array([0.4]))
    ((0.5, 5.0), (0.125, 5.0))
    """
    lower, upper = widened((min(bounds[0], free[0]), max(bounds[1], free[1])), ritz)
    if lower < min(bounds[0], free[0]) or (lower, upper) == bounds:
        lower = min(lower, bounds[0] / _DEEPER)
    return lower, upper


def _run(
    system: System, x: Array, r: Array, monitor: Monitor, bounds: tuple[float, float], growth: float
) -> bool:
    """Iterate to the end, or until the residual is so many times what theory has it: then True."""
    lower, upper = bounds
    start, first = monitor.iterations, max(monitor.residuals[-1], monitor.lowest)
    centre = (upper + lower) / 2
    radius = max((upper - lower) / 2, 1e-6 * centre)
    sigma = centre / radius  # 2.
    rho = 1.0 / sigma
    monitor.factor = 1.0 / (sigma + math.sqrt(sigma**2 - 1.0))
    d = vectors.axpby(1.0 / centre, r, 0.0, r, r.like())
    while True:  # 3.
        vectors.axpy(1.0, d, x)  # 4.
        system.residual(x, r)  # 5., from x itself instead of by recursion: same cost, no drift
        if monitor.done(x, r, lazy=True):
            return math.isfinite(growth) and monitor.forgive(x, r)
        if monitor.residuals[-1] > max(
            growth * first * _shrunk(monitor.factor, monitor.iterations - start), _SEEN
        ):
            return True
        previous, rho = rho, 1.0 / (2.0 * sigma - rho)  # 6.
        vectors.axpby(2.0 * rho / radius, r, rho * previous, d, d)  # 7.


def _shrunk(factor: float, steps: int) -> float:
    """1 / T_k(sigma), what k steps leave of a residual in theory; `factor` is sigma - sqrt(sigma^2 - 1).

    >>> _shrunk(0.5, 1), round(_shrunk(0.5, 2), 3)  # of sigma = 1.25: T_1 = sigma, T_2 = 2 sigma^2 - 1
    (0.8, 0.471)
    """
    return 2.0 * factor**steps / (1.0 + factor ** (2 * steps))
