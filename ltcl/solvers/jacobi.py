# SPDX-License-Identifier: BSD-3-Clause
"""Jacobi iteration (eq. 20): what the projector must still add is what the last guess lacks.

    l^(k+1) = l_out - R l^(k) = l^(k) + (l_out - S l^(k))

Started from zero, k steps equal the k-term inverse Neumann series; the forward dual (eq. 18) is the same
iteration on I - A. It converges where the spectral radius of R is below 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl.device import Array, vectors
from ltcl.solvers.stopping import Monitor, System


@dataclass(frozen=True)
class Jacobi:
    """No options."""

    name: ClassVar[str] = "jacobi"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        while not monitor.done(x, r, lazy=True):
            vectors.axpy(1.0, r, x)  # x = x + r, in place
            system.residual(x, r)  # r = l_out - S x: the next step, and the measure of this one
