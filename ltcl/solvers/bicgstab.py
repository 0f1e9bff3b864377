# SPDX-License-Identifier: BSD-3-Clause
"""BiCGStab: any S, two products a step, six vectors of memory however many steps it takes.

It asks for no bounds, no symmetry and no transpose, but promises nothing: residuals swing, and a step may
not exist (a division by 0). Such a column starts anew from where it is; where even a fresh start has no
step it rests for good. Each right-hand side has coefficients of its own and rests once it is solved.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 7.7.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl.device import Array, vectors
from ltcl.solvers.columns import ratio
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_ORTHOGONAL = 2.0**-20  # cosine between two vectors, below which their float32 inner product is rounding


@dataclass(frozen=True)
class BiCGStab:
    """No options."""

    name: ClassVar[str] = "bicgstab"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        state = _State(r)
        while not monitor.done(x, r, replace=True):
            step = monitor.unsolved & ~state.broken
            state.direction(r, monitor.norms, step)
            state.advance(system, x, r, step)
            if state.broken.any() and not (monitor.unsolved & ~state.broken).any():
                monitor.give_up(Status.NO_STEP)
                return


class _State:
    """What one step leaves to the next, column by column (k,)."""

    def __init__(self, r: Array) -> None:
        k = r.columns
        self.shadow, self.p, self.v, self.t = r.copy(), r.copy(), r.like(), r.like()  # 1., 2.
        self.shadow_norm = np.ones(k)
        self.rho = np.ones(k)
        self.beta_over_rho = np.zeros(k)  # alpha / omega / rho of the step before
        self.omega = np.zeros(k)
        self.fresh = np.ones(k, bool)  # to start anew: at first, and where no step went on
        self.broken = np.zeros(k, bool)

    def direction(self, r: Array, norms: np.ndarray, step: np.ndarray) -> None:
        """The next p, and rho = <r, r_0*>; columns whose rho has vanished start anew with r_0* = r."""
        rho = vectors.dot(r, self.shadow)
        self.fresh |= step & (np.abs(rho) <= _ORTHOGONAL * norms * self.shadow_norm)
        start, go_on = self.fresh & step, step & ~self.fresh
        vectors.axpby_columns(start, r, ~start, self.shadow, self.shadow)
        self.shadow_norm = np.where(start, norms, self.shadow_norm)
        self.rho = np.where(start, norms**2, rho)
        beta = np.where(go_on, self.rho * self.beta_over_rho, 0.0)  # 8.
        vectors.axpby_columns(beta, self.p, -beta * self.omega, self.v, self.p)  # 9.
        vectors.axpby_columns(1.0, r, 1.0, self.p, self.p)

    def advance(self, system: System, x: Array, r: Array, step: np.ndarray) -> None:
        """One step of x and r in the columns `step`; those without one start anew, or are broken."""
        system.apply(self.p, self.v)
        sigma, norm = vectors.dot(self.v, self.shadow), vectors.norm(self.v)
        lost = step & np.isfinite(norm) & (np.abs(sigma) <= _ORTHOGONAL * norm * self.shadow_norm)
        self.broken |= lost & self.fresh
        step = step & ~lost
        alpha = ratio(self.rho, sigma, step)  # 4.
        vectors.axpby_columns(alpha, self.p, 1.0, x, x)  # 6., its first half
        vectors.axpby_columns(-alpha, self.v, 1.0, r, r)  # 5., s in place of r
        system.apply(r, self.t)
        square, product = vectors.dot(self.t, self.t), vectors.dot(self.t, r)
        self.omega = ratio(product, square, step & (square != 0.0))  # 6.
        vectors.axpby_columns(self.omega, r, 1.0, x, x)  # 6.
        vectors.axpby_columns(-self.omega, self.t, 1.0, r, r)  # 7.
        self.fresh = ~step | (self.omega == 0.0)
        self.beta_over_rho = ratio(alpha, self.omega * self.rho, ~self.fresh)
