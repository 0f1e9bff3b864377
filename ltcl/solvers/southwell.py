# SPDX-License-Identifier: BSD-3-Clause
"""Southwell's relaxation: the largest residual first, which is what progressive radiosity does with light.

    i = argmax |r_i|,  l_i += r_i / S_ii,  r -= S[:, i] r_i / S_ii

With ``rows=1`` it is the sequential method, which converges for every self-adjoint S. With more, each of as
many equal parts of the picture relaxes its own largest residual at the same moment, so that a device has
work; too many at once behave like Jacobi and may diverge, which the monitor sees.

An iteration is as many steps as relax N rows, and so costs what one product costs. Source: R. V. Southwell,
Relaxation Methods in Engineering Science, 1940; M. Cohen et al., A Progressive Refinement Approach to Fast
Radiosity Image Generation, SIGGRAPH 1988.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ltcl import checks
from ltcl.device import Array
from ltcl.operators.steps import Steps
from ltcl.solvers.stopping import Monitor, System

_STEPS = 64  # of an iteration, where `rows` is not given and there are that many pixels


@dataclass(frozen=True)
class Southwell:
    """Options: ``rows`` relaxed in one step; a 64th of the picture when not given."""

    name: ClassVar[str] = "southwell"
    rows: int | None = None

    def __post_init__(self) -> None:
        if self.rows is not None:
            checks.count("rows", self.rows)

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if monitor.done(x, r):
            return
        n = x.shape[0]
        rows = min(max(1, n // _STEPS) if self.rows is None else self.rows, n)
        steps = Steps(system.S, self.name, x, r, rows)
        while True:
            system.products += 1
            for _ in range(-(-n // rows)):
                steps.step()
            if monitor.done(x, r, recursive=True):
                return
