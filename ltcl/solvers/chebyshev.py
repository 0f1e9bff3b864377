# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev iteration: the best polynomial in S for a spectrum known to lie in an interval.

Where the paper's series needs rho(R) < 1, this converges for every albedo below one: of a Lambertian scene
the spectrum of S lies in [1/2, 1 + max row sum of R], which costs nothing to know (`theory.free_bounds`).
No inner products after the start, so nothing is read back but the residual, every few products. Not for
spectra with large imaginary parts, nor with eigenvalues on both sides of 0: the monitor sees residuals grow.

Of other scenes the bounds may leave out eigenvalues, and then the residual grows by their eigenvectors. A few
steps of GMRES take those out and tell their eigenvalues; the bounds are widened and the iteration goes on.
The same steps at the start, `arnoldi` of them, draw the bounds in. They solve as well as they measure: in
boxes of rho(R) = 4 a solve to 1 % takes 4 products in place of 9, for a handful of inner products read back.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks, theory
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.solvers import gmres
from ltcl.solvers.stopping import Monitor, System
from ltcl.solvers.survey import refined, widened

_GROWTH = 10.0  # times the residual at the start of a run: above what weights of surfaces may do to norms
_REPAIRS = 3  # times that bounds are widened before the monitor alone decides
_REPAIR_STEPS = 5
_FIRST_STEPS = 2


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
            bounds = refined(bounds, learnt.ritz_values())
        for _ in range(_REPAIRS):
            if not _run(system, x, r, monitor, bounds, _GROWTH):
                return
            # What has grown are the eigenvectors that the bounds leave out; few steps find their eigenvalues.
            _, learnt = gmres.cycle(system, x, r, monitor, _REPAIR_STEPS)
            if monitor.done(x, r):
                return
            bounds = widened(bounds, learnt.ritz_values())
        _run(system, x, r, monitor, bounds, math.inf)


def _run(
    system: System, x: Array, r: Array, monitor: Monitor, bounds: tuple[float, float], growth: float
) -> bool:
    """Iterate to the end, or until the residual has grown so many times: then True."""
    lower, upper = bounds
    first = monitor.residuals[-1]
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
            return False
        if monitor.residuals[-1] > growth * first:
            return True
        previous, rho = rho, 1.0 / (2.0 * sigma - rho)  # 6.
        vectors.axpby(2.0 * rho / radius, r, rho * previous, d, d)  # 7.
