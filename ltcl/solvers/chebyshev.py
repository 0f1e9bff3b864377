# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev iteration: the best polynomial in S for a spectrum known to lie in an interval.

Where the paper's series needs rho(R) < 1, this converges for every albedo below one: of a Lambertian scene
the spectrum of S lies in [1/2, 1 + max row sum of R], which costs nothing to know (`theory.free_bounds`).
No inner products, so nothing is read back between products but the residual. Not for spectra with large
imaginary parts; there the monitor sees the residual grow.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks, theory
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.solvers.stopping import Monitor, System


@dataclass(frozen=True)
class Chebyshev:
    """Options: ``spectrum=(lower, upper)``, between which that of S lies; the free bounds when not given."""

    name: ClassVar[str] = "chebyshev"
    spectrum: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.spectrum is None:
            return
        try:
            lower, upper = self.spectrum
        except (TypeError, ValueError):
            raise InputError(f"spectrum is {self.spectrum!r}; it must be (lower, upper)") from None
        checks.number("spectrum[1]", upper, least=checks.number("spectrum[0]", lower, above=0.0))

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        lower, upper = self.spectrum or theory.free_bounds(system.S)
        centre = (upper + lower) / 2
        radius = max((upper - lower) / 2, 1e-6 * centre)
        sigma = centre / radius  # 2.
        rho = 1.0 / sigma
        d = vectors.axpby(1.0 / centre, r, 0.0, r, r.like())
        while not monitor.done(x, r):  # 3.
            vectors.axpy(1.0, d, x)  # 4.
            system.residual(x, r)  # 5., from x itself instead of by recursion: same cost, no drift
            previous, rho = rho, 1.0 / (2.0 * sigma - rho)  # 6.
            vectors.axpby(2.0 * rho / radius, r, rho * previous, d, d)  # 7.
