# SPDX-License-Identifier: BSD-3-Clause
"""`auto`: choose a method before the first step, and say why.

Row sums show whether the plain iteration is best. Else the first solve with S tries GMRES, for no
more steps than a survey and Chebyshev within free bounds take: a survey pays where that fails, or
if S is solved again (`ltcl.solvers.survey`). The least estimated time decides: bytes over
bandwidth, launches, waits. The speeds are measured, once per device. Gauss-Seidel is not tried:
GMRES takes fewer products in all scenes of the table in theory, and a sweep costs a product at
least, on a GPU two launches a block more.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

from ltcl import theory
from ltcl.device import Array, tuning
from ltcl.errors import InputError, MemoryLimitError, ToleranceError
from ltcl.operators import Operator
from ltcl.solvers.chebyshev import Chebyshev
from ltcl.solvers.direct import Direct
from ltcl.solvers.krylov import CG, GMRES
from ltcl.solvers.method import Method
from ltcl.solvers.problem import LinearProblem
from ltcl.solvers.refinement import step_tolerance
from ltcl.solvers.result import Solution
from ltcl.solvers.stationary import Jacobi
from ltcl.solvers.stopping import CountedOperator, Monitor
from ltcl.solvers.survey import STEPS, Survey, survey

# A dense factorization of no more pixels takes less time than launching kernels.
SMALL = 512

# A dense factorization of more pixels takes gigabytes and minutes.
LARGEST_DIRECT = 8192

# Relative residual that float32 products reach for certain.
PRECISE = 1e-6

# Largest relative residual that a plan is made for, whatever the tolerance.
LOOSEST_PLAN = 0.5

# Right-hand sides of one product.
COLUMNS_OF_A_PRODUCT = 8


@dataclass(frozen=True, kw_only=True)
class StepCost:
    """The needs of a method between two products: vectors read or written, launches and waits."""

    vectors: int
    launches: int
    waits: float


STEP_COSTS = {
    "chebyshev": StepCost(vectors=4, launches=1, waits=0.5),
    "cg": StepCost(vectors=9, launches=3, waits=0.5),
    "gmres": StepCost(vectors=12, launches=5, waits=1.0),
}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A method, and what it needs, roughly.

    `nbytes` are to be moved, `overhead` are seconds of launches and waits.
    """

    method: Method
    products: float
    nbytes: float = 0.0
    overhead: float = 0.0
    operations: float = 0.0

    def seconds(self, bandwidth: float, flops: float) -> float:
        """Return the estimated time."""
        return self.nbytes / bandwidth + self.overhead + self.operations / flops

    def __str__(self) -> str:
        unit = "product" if self.products == 1 else "products"
        return f"{self.method.name}: {self.products:g} {unit}"


@dataclass(frozen=True, kw_only=True)
class PlannedMethod:
    """A method to try, why, and the products that it took to know."""

    method: Method
    reason: str
    products: int = 0


class GMRESTrial(GMRES):
    """A single cycle of GMRES, however many steps the caller allows."""

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, for one cycle."""
        maxiter = min(self.restart, monitor.rule.maxiter)
        monitor.rule = dataclasses.replace(monitor.rule, maxiter=maxiter)
        super().iterate(system, x, r, monitor)


def solve_automatically(problem: LinearProblem) -> Solution:
    """Return the solution of the first planned method that converges, else the best iterate.

    Its products are those of all methods.
    """
    attempts = _Attempts(problem)
    attempts.run()
    return attempts.solution()


class _Attempts:
    """The methods that were tried for a problem, and what came of them."""

    def __init__(self, problem: LinearProblem) -> None:
        self.problem = problem
        self.target = min(problem.required_rtol, LOOSEST_PLAN)
        self.solutions: list[Solution] = []
        self.reasons: list[str] = []
        self.products = 0
        self.failure: MemoryLimitError | InputError | None = None
        if problem.exact is None:
            self._refine_where_needed()
        if self.problem.exact is not None:
            self.target = step_tolerance(problem.S)

    def _refine_where_needed(self) -> None:
        """Refine in float64 if the tolerance is below what float32 products tell of a large S."""
        S = self.problem.S
        pixels = S.shape[0]
        if self.target >= PRECISE or pixels <= SMALL:
            return
        if S.product_float64() is not None:
            self.problem = dataclasses.replace(self.problem, exact=S)
            self.reasons.append(
                f"refined in float64, since rtol={self.target:g} is below what float32 products "
                "reach"
            )
        elif pixels > LARGEST_DIRECT:
            raise ToleranceError(
                f"rtol is {self.target:g}, less than float32 products tell of S, whose numbers are "
                f"on the device alone and whose N = {pixels} is too large to factorize; it must be "
                "at least 1e-06",
                PRECISE,
            )

    def run(self) -> None:
        """Try the planned methods until one converges."""
        S = self.problem.S
        columns = self.problem.b[0].size
        is_refined = self.problem.exact is not None
        for planned in plan(S, self.target, columns, is_refined):
            self.reasons.append(planned.reason)
            self.products += planned.products
            if self._try(planned.method):
                return

    def _try(self, method: Method) -> bool:
        """Try a method, from the best iterate so far; return whether it converged."""
        try:
            solution = method.solve(self.problem)
        except (MemoryLimitError, InputError) as error:
            # No room, or no transpose; but what the first method refuses is bad input.
            if not self.solutions and isinstance(error, InputError):
                raise
            self.failure = error
            self.reasons.append(f"{method.name} failed: {error}")
            return False
        self.solutions.append(solution)
        self.products += solution.products
        if solution.converged:
            return True
        self.reasons.append(f"{solution.method} ended {solution.status.name.lower()}")
        if solution.residual < 1.0:
            start = solution.x / self.problem.unit
            self.problem = dataclasses.replace(self.problem, x0=start)
        return False

    def solution(self) -> Solution:
        """Return the last solution if it converged, else the best one."""
        if self.failure is not None and not self.solutions:
            raise self.failure
        best = self.solutions[-1]
        if not best.converged:
            best = min(self.solutions, key=lambda solution: solution.residual)
        return dataclasses.replace(best, products=self.products, reason="; ".join(self.reasons))


def plan(
    S: Operator, rtol: float, columns: int, is_refined: bool = False
) -> Iterator[PlannedMethod]:
    """Return the methods to try for S x = b to `rtol`, the next one where those before fail."""
    pixels = S.shape[0]
    if pixels <= SMALL:
        reason = f"direct: {pixels} pixels are few enough for a dense factorization"
        yield PlannedMethod(method=Direct(), reason=reason)
        return
    if rtol < PRECISE and pixels <= LARGEST_DIRECT:
        reason = f"direct: rtol={rtol:g} is below what float32 products reach"
        yield PlannedMethod(method=Direct(), reason=reason)
        return

    row_sums = S.row_sum_range()
    rho = max(row_sums.largest - 1.0, 1.0 - row_sums.least)
    if not math.isfinite(rho):
        reason = "gmres: it needs no bounds, and row sums of S leave float32"
        yield PlannedMethod(method=GMRES(), reason=reason)
        return
    plain = Candidate(method=Jacobi(), products=theory.series_products(rho, rtol))
    free_products = theory.chebyshev_products(*theory.free_bounds(S), rtol)
    free = Candidate(method=Chebyshev(), products=free_products)
    if plain.products <= free.products:
        reason = f"{plain}, {free}; row sums of R are at most {rho:.2g}"
        yield PlannedMethod(method=plain.method, reason=reason)
    elif not is_refined and columns <= COLUMNS_OF_A_PRODUCT and not _was_solved(S):
        S.known.was_tried = True
        max_products = min(STEPS + int(free.products), GMRES.restart)
        reason = f"gmres: at most {max_products} products, without a survey at the first solve"
        yield PlannedMethod(method=GMRESTrial(max_products), reason=reason)
    yield from _plan_by_survey(S, rtol, columns)


def _was_solved(S: Operator) -> bool:
    """Return whether S was solved before, so that a survey pays."""
    known = S.known
    return known.was_tried or known.survey is not None or known.factorization is not None


def _plan_by_survey(S: Operator, rtol: float, columns: int) -> Iterator[PlannedMethod]:
    """Return the methods in the order of their estimated time, and two that need no bounds."""
    made_before = S.known.survey is not None
    surveyed = survey(S)
    candidates = _candidates(S, rtol, columns, surveyed)
    bandwidth = _bandwidth(S.device)
    flops = _flops()
    candidates.sort(key=lambda candidate: candidate.seconds(bandwidth, flops))
    # Ranks of a cluster measure different speeds, but have to make one choice.
    candidates = S.device.agreed(candidates)

    ranking = ", ".join(map(str, candidates))
    reason = f"fastest first: {ranking}; {surveyed}"
    products = len(surveyed.residuals) - 1
    if made_before:
        reason += " made before"
        products = 0
    first = candidates[0].method
    yield PlannedMethod(method=first, reason=reason, products=products)
    if not isinstance(first, GMRES):
        yield PlannedMethod(method=GMRES(), reason="gmres: next, as it needs no bounds")
    if S.shape[0] <= LARGEST_DIRECT and not isinstance(first, Direct):
        yield PlannedMethod(method=Direct(), reason="direct: last, as products did not do")


def _candidates(S: Operator, rtol: float, columns: int, surveyed: Survey) -> list[Candidate]:
    """Return what each method that fits S needs."""
    krylov_products = surveyed.krylov_products(rtol)
    candidates = [_iterative_candidate(S, columns, GMRES(), krylov_products)]
    if surveyed.in_an_interval:
        if surveyed.self_adjoint:
            # One more product confirms the end.
            candidates.append(_iterative_candidate(S, columns, CG(), krylov_products + 1))
        products = theory.chebyshev_products(*surveyed.spectrum, rtol)
        chebyshev = Chebyshev(surveyed.spectrum)
        candidates.append(_iterative_candidate(S, columns, chebyshev, products))
    if S.shape[0] <= LARGEST_DIRECT and S.has_entries:
        candidates.append(_direct_candidate(S, columns))
    return candidates


def _iterative_candidate(S: Operator, columns: int, method: Method, products: float) -> Candidate:
    """Return what so many products by an iterative method need."""
    cost = STEP_COSTS[method.name]
    passes = math.ceil(columns / COLUMNS_OF_A_PRODUCT)
    vector_bytes = 4.0 * S.shape[0] * columns
    nbytes = S.nbytes * passes + S.bytes_read() + vector_bytes * cost.vectors
    launch, wait = _overheads(S.device)
    overhead = passes * cost.launches * launch + cost.waits * wait
    return Candidate(
        method=method,
        products=products,
        nbytes=products * nbytes,
        overhead=products * overhead,
    )


def _direct_candidate(S: Operator, columns: int) -> Candidate:
    """Return what a dense factorization, if it is not there yet, and its use need."""
    n = S.shape[0]
    operations = 4.0 * n * n * columns
    if S.known.factorization is None:
        operations += 2.0 / 3.0 * n**3
    return Candidate(
        method=Direct(),
        products=0,
        # Both triangles, and S for the residual.
        nbytes=16.0 * n * n,
        operations=operations,
    )


_bandwidth = functools.cache(tuning.bandwidth)
_flops = functools.cache(tuning.factorization_flops)
_overheads = functools.cache(tuning.overheads)
