# SPDX-License-Identifier: BSD-3-Clause
"""Iterative refinement: solves with a compressed S~ = S + E, judged by the exact S.

    x^(k+1) = x^(k) + S~^-1 (b - S x^(k))

With solves to a tolerance t, each step reduces the error to about ||S~^-1 E|| + t of it (Higham,
Accuracy and Stability of Numerical Algorithms, 2nd ed., chapter 12). The iterate is kept in float64
on the host.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators import Operator
from ltcl.solvers.problem import LinearProblem, unscale
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import CountedOperator, Monitor

# Products in float32 leave a relative residual of about this.
FLOAT32_FLOOR = 2.0**-20

# Tolerances of the solve for one step: many short solves waste products by S, and long ones waste
# products by S~.
MIN_STEP_TOLERANCE = 1e-3
MAX_STEP_TOLERANCE = 0.1

# Share of the reduction still missing that the last solve aims at.
LAST_STEP_SHARE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Correction:
    """The step d of S~ d = r, and the products it took; `failure` says why there is none."""

    step: np.ndarray | None = None
    products: int = 0
    failure: Status | None = None


class Corrector(Protocol):
    """A method that computes the steps of a refinement."""

    name: ClassVar[str]

    def correct(self, S: Operator, r: Array, tolerance: float, maxiter: int) -> Correction:
        """Solve S d = r to a relative residual of `tolerance`."""
        ...


def step_tolerance(S: Operator) -> float:
    """Return the tolerance of solves with S~, which its own error makes no smaller."""
    return min(max(S.solution_error, MIN_STEP_TOLERANCE), MAX_STEP_TOLERANCE)


def refine(method: Corrector, problem: LinearProblem, exact: Operator) -> Solution:
    """Refine solutions of S~ x = b until the residual by `exact` is within the tolerance."""
    S = problem.S
    b = problem.b
    right = S.device.upload(b)
    norms = vectors.norm(right)
    system = CountedOperator(S=exact, b=right, norms=norms, host=b)
    needs_float64 = exact.has_cheap_float64_product or problem.required_rtol < FLOAT32_FLOOR
    system.in_float64 = needs_float64 and system.product_float64 is not None

    x = np.zeros(b.shape)
    r = right.copy()
    if problem.x0 is not None:
        x = problem.x0.astype(np.float64)
        norms = system.residual(x, r)
    monitor = Monitor(system=system, rule=problem.rule)
    while not monitor.check(x, r, norms[None]):
        # A residual of 0 in the monitor has ended the loop; the quotient may be infinite.
        missing = float(np.divide(problem.required_rtol, monitor.residuals[-1]))
        tolerance = max(step_tolerance(S), LAST_STEP_SHARE * missing)
        tolerance = min(tolerance, MAX_STEP_TOLERANCE)
        correction = method.correct(S, r, tolerance, problem.rule.maxiter)
        system.products += correction.products
        if correction.failure is not None or correction.step is None:
            monitor.status = correction.failure
            break
        x = x + correction.step
        norms = system.residual(x, r)

    x = monitor.result(x)
    if not system.in_float64:
        x = x.astype(np.float32)
    return monitor.solution(unscale(x, problem.unit), method.name)
