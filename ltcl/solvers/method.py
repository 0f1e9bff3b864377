# SPDX-License-Identifier: BSD-3-Clause
"""The contract of a method, and how a problem is solved with an iterative one.

A method is a frozen dataclass whose fields are its options, checked in `__post_init__`. An
iterative method implements `iterate`; the rest is derived.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators import Operator
from ltcl.solvers.coefficients import CoefficientSpace
from ltcl.solvers.problem import LinearProblem, unscale
from ltcl.solvers.refinement import Correction, refine
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import CountedOperator, Monitor, StoppingRule

# A solve that ended early is a step of a refinement if it left no more of the residual than this.
USEFUL_REDUCTION = 0.5


class Method(abc.ABC):
    """A method of `ltcl.solve`, which knows it by `name`."""

    name: ClassVar[str]

    @abc.abstractmethod
    def solve(self, problem: LinearProblem) -> Solution:
        """Return the solution of a problem, in the units of the caller."""


@dataclass(frozen=True, kw_only=True, eq=False)
class IterationResult:
    """The best iterate x, in pixels on the device, and the monitor that watched the iteration.

    `residual` is b - S x, if it was asked for and the iteration converged.
    """

    x: Array
    monitor: Monitor
    residual: Array | None = None


class IterativeMethod(Method):
    """A method that improves an iterate on the device by products with S."""

    @abc.abstractmethod
    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""

    def needs_pixels(self, S: Operator) -> bool:
        """Return whether the method cannot run on the coefficients of a compressed S."""
        del S
        return False

    def solve(self, problem: LinearProblem) -> Solution:
        """Iterate from the start of the problem, or refine the solutions of a compressed S."""
        if problem.exact is not None:
            return refine(self, problem, problem.exact)
        device = problem.S.device
        start = None
        if problem.x0 is not None:
            start = device.upload(problem.x0)
        result = self.run(
            problem.S,
            device.upload(problem.b),
            problem.rule,
            start=start,
            host_b=problem.b,
            with_residual=problem.with_residual,
        )
        monitor = result.monitor
        x = unscale(result.x.get(), problem.unit)
        residual = None
        if result.residual is not None:
            residual = unscale(result.residual.get(), problem.unit)
        return monitor.solution(x, self.name, residual=residual)

    def correct(self, S: Operator, r: Array, tolerance: float, maxiter: int) -> Correction:
        """Solve S d = r to a relative residual of `tolerance`."""
        result = self.run(S, r, StoppingRule(rtol=tolerance, maxiter=maxiter))
        monitor = result.monitor
        is_useful = monitor.lowest <= USEFUL_REDUCTION
        failure = monitor.status
        if is_useful:
            failure = None
        return Correction(
            step=result.x.get(),
            products=monitor.system.products,
            failure=failure,
        )

    def run(
        self,
        S: Operator,
        b: Array,
        rule: StoppingRule,
        *,
        start: Array | None = None,
        host_b: np.ndarray | None = None,
        with_residual: bool = False,
    ) -> IterationResult:
        """Iterate on S x = b from `start`, or zero; `host_b` is b before it became float32."""
        basis = S.coefficient_basis
        if basis is not None and not self.needs_pixels(S):
            space = CoefficientSpace(basis=basis, operator=S.on_coefficients())
            return self._run_on_coefficients(space, b, rule, start, with_residual)
        norms = vectors.norms(b)[0]
        system = CountedOperator(S=S, b=b, norms=norms, host=host_b)
        return self._run(system, rule, start, norms, with_residual)

    def _run_on_coefficients(
        self,
        space: CoefficientSpace,
        b: Array,
        rule: StoppingRule,
        start: Array | None,
        with_residual: bool,
    ) -> IterationResult:
        """Iterate on (I + C) a = W b, and convert the result to pixels."""
        basis = space.basis
        right = basis.apply(b)
        norms, norms_of_right = vectors.norms(b, right)
        # Tolerances are relative to the whole of b, also where W keeps only a part of it.
        system = CountedOperator(S=space.operator, b=right, norms=norms, on_coefficients=True)
        if start is not None:
            start = basis.apply(start)
        result = self._run(system, rule, start, norms_of_right, with_residual)
        residual = result.residual
        if residual is not None:
            residual = basis.apply_transpose(residual)
        x = space.to_pixels(result.x, right, b)
        return IterationResult(x=x, monitor=result.monitor, residual=residual)

    def _run(
        self,
        system: CountedOperator,
        rule: StoppingRule,
        start: Array | None,
        norms_of_b: np.ndarray,
        with_residual: bool,
    ) -> IterationResult:
        """Compute the first residual, then iterate until the monitor ends it."""
        if start is None:
            # The residual of zero is b, and costs no product.
            x = vectors.fill(system.b.like(), 0.0)
            r = system.b.copy()
            norms = norms_of_b
        else:
            x = start
            r = system.b.like()
            norms = system.residual(x, r)
        monitor = Monitor(system=system, rule=rule)
        if not monitor.check(x, r, norms[None]):
            self.iterate(system, x, r, monitor)
        has_residual = with_residual and monitor.status is Status.CONVERGED
        residual = r if has_residual else None
        return IterationResult(x=monitor.result(x), monitor=monitor, residual=residual)
