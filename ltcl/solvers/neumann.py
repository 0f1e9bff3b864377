# SPDX-License-Identifier: BSD-3-Clause
"""The inverse Neumann series (eq. 10) by products: l_d = (I - R + R^2 - ...) l_out.

Each term is the last one times -R, and the sum of k of them lacks exactly the next one: the (k+1)-th term
is the residual. It converges where the spectral radius of R is below 1, to the iterates of Jacobi up to
rounding; its rounding errors, unlike Jacobi's, are not corrected by later terms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl.device import Array, vectors
from ltcl.solvers.stopping import Monitor, System


@dataclass(frozen=True)
class Neumann:
    """No options."""

    name: ClassVar[str] = "neumann"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        term, following = r, r.like()
        while not monitor.done(x, term, recursive=True, lazy=True):
            vectors.axpy(1.0, term, x)
            system.apply(term, following, scale=-1.0, add=term)  # -R term = term - S term
            term, following = following, term
