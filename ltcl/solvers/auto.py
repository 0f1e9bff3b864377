# SPDX-License-Identifier: BSD-3-Clause
"""`auto`: choosing a method before the first step, and saying why.

Row sums show whether the plain iteration is best. Else the first solve with S tries GMRES, for no
more steps than a survey and Chebyshev within free bounds: a survey pays where that fails, or S is
solved again. Made once in the life of S, it is three steps of GMRES from a random picture: Ritz
values estimate the spectrum, residuals how fast Krylov methods converge, directions whether S is
self-adjoint. The least estimated time decides: bytes over bandwidth, launches, waits. Speeds that
matter are measured, once per device.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ltcl import theory
from ltcl.device import Array, Device, tuning, vectors
from ltcl.operators import Operator
from ltcl.solvers.krylov import CG, GMRES, KrylovSpace
from ltcl.solvers.precision import Direct
from ltcl.solvers.stationary import Chebyshev, Jacobi, drawn_in
from ltcl.solvers.stopping import Monitor, System

SMALL = 512  # pixels: below, a dense factorization takes less time than launching kernels
LARGEST_DIRECT = 8192  # pixels: above, a dense factorization takes gigabytes and minutes
PRECISE = 1e-6  # relative residual that float32 products reach for certain
STEPS = 3  # of a survey
_AT_ONCE = 8  # right-hand sides in one product
_SELF_ADJOINT = (
    0.02  # defect of R up to which inner products are nearly those of a self-adjoint one
)
_SLENDER = 0.25  # of the smallest real part: imaginary parts that an interval may leave out
_LAUNCHES = 16  # timed together
# Vectors read or written, launches and waits for each product.
_STEPS = {"chebyshev": (4, 1, 0.5), "cg": (9, 3, 0.5), "gmres": (12, 5, 1.0)}


@dataclass(frozen=True)
class Survey:
    """Complex Ritz values of S, an interval around their real parts, within the free bounds, and more.

    `residuals` are those of GMRES after 0, 1, ... products, relative; `defect` is the part of R
    that is not self-adjoint in the inner product of `S.weights`, or the plain one: 0 where it is, 1
    of a rotation.
    """

    ritz: np.ndarray
    spectrum: tuple[float, float]
    residuals: tuple[float, ...]
    defect: float

    @property
    def in_an_interval(self) -> bool:
        """Whether all eigenvalues seem to lie near some interval of positive numbers."""
        least = float(np.min(np.real(self.ritz), initial=np.inf))
        return least > 0.0 and np.max(np.abs(np.imag(self.ritz)), initial=0.0) <= _SLENDER * least

    @property
    def self_adjoint(self) -> bool:
        """Whether cg will work as in theory."""
        return self.defect <= _SELF_ADJOINT

    def krylov_products(self, rtol: float) -> float:
        """Products of a Krylov method to `rtol`; infinite where it stalls."""
        if self.residuals[-1] <= rtol:  # they never grow
            return float(np.argmax(np.array(self.residuals) <= rtol))
        factor = self.residuals[-1] / self.residuals[-2]
        missing = (
            math.log(rtol / self.residuals[-1]) / math.log(factor) if factor < 1.0 else math.inf
        )
        return len(self.residuals) - 1.0 + float(np.ceil(missing))

    def __str__(self) -> str:
        real, imaginary = np.real(self.ritz), np.imag(self.ritz)
        least, most = np.min(real, initial=np.inf), np.max(real, initial=-np.inf)
        rotation = (
            "" if self.in_an_interval else f" with imaginary parts up to {np.max(imaginary):.2g}"
        )
        spectrum = f"eigenvalues of S seen between {least:.2g} and {most:.2g}{rotation}"
        return f"{self.defect:.2g} of R is not self-adjoint, {spectrum} by {len(self.residuals) - 1} products"


def survey(S: Operator) -> Survey:
    """The survey of S, made at the first call."""
    if S.known.survey is not None:
        return S.known.survey
    start = S.device.upload(np.random.default_rng(0).uniform(size=S.shape[0]))
    space, residuals, ended = (
        KrylovSpace(S, start, np.ones(1), min(STEPS, S.shape[0])),
        [1.0],
        False,
    )
    while space.count < space.steps and not ended:
        ended = space.extend()[0]
        residuals.append(float(space.residuals[0]))
    ritz = space.ritz_values()
    spectrum = drawn_in(theory.free_bounds(S), S, ritz)
    S.known.survey = Survey(ritz, spectrum, tuple(residuals), _defect(S, space))
    return S.known.survey


def _defect(S: Operator, space: KrylovSpace) -> float:
    """||G - G^T|| / 2 ||G|| of G = V^T W R V, from S V = V H: products that are made already."""
    steps = space.count
    basis = [dataclasses.replace(space.V.rows(j, 1), shape=S.shape[:1]) for j in range(steps + 1)]
    gram = S.device.empty((steps * (steps + 1), 1))  # <v_i, W v_j>, read in one go
    weights = None if S.weights is None else S.device.upload(S.weights / np.max(S.weights))
    for j, v in enumerate(basis[:steps]):
        wv = v if weights is None else vectors.scale_rows(weights, v, v.like())
        for i, u in enumerate(basis):
            vectors.queue_dot(u, wv, gram, j * (steps + 1) + i)
    R = space.H[0, : steps + 1, :steps] - np.eye(steps + 1, steps)
    G = gram.get().reshape(steps, steps + 1).astype(np.float64) @ R
    return float(np.linalg.norm(G - G.T) / (2.0 * np.linalg.norm(G) or 1.0))


class _Candidate(NamedTuple):
    """A method, and what it needs, roughly: bytes to move, seconds of launches and waits, operations."""

    method: Any
    products: float
    nbytes: float = 0.0
    overhead: float = 0.0
    operations: float = 0.0

    def seconds(self, bandwidth: float, flops: float) -> float:
        return self.nbytes / bandwidth + self.overhead + self.operations / flops

    def __str__(self) -> str:
        return f"{self.method.name}: {self.products:g} product{'s' * (self.products != 1)}"


class _Trial(GMRES):
    """One cycle, however many steps the caller allows."""

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        monitor.rule = dataclasses.replace(
            monitor.rule, maxiter=min(self.restart, monitor.rule.maxiter)
        )
        super().iterate(system, x, r, monitor)


def plan(
    S: Operator, rtol: float, columns: int, refines: bool = False
) -> Iterator[tuple[Any, str, int]]:
    """Methods to try for S x = b to `rtol`, one where those before fail; why; products it took to know."""
    n = S.shape[0]
    if n <= SMALL:
        yield Direct(), f"direct: {n} pixels are few enough for a dense factorization", 0
        return
    if rtol < PRECISE and n <= LARGEST_DIRECT:
        yield Direct(), f"direct: rtol={rtol:g} is below what float32 products reach", 0
        return
    least, _, most = theory.row_sum_range(S)
    rho = max(most - 1.0, 1.0 - least)
    if not math.isfinite(rho):
        yield GMRES(), "gmres: it needs no bounds, and row sums of S leave float32", 0
        return
    plain = _Candidate(Jacobi(), theory.series_products(rho, rtol))
    free = _Candidate(Chebyshev(), theory.chebyshev_products(*theory.free_bounds(S), rtol))
    if plain.products <= free.products:
        yield plain.method, f"{plain}, {free}; row sums of R are at most {rho:.2g}", 0
    elif not (refines or columns > _AT_ONCE or _is_known(S)):
        S.known.was_tried = True
        most = min(STEPS + int(free.products), GMRES.restart)
        yield (
            _Trial(most),
            f"gmres: at most {most} products, without a survey at the first solve",
            0,
        )
    made_before = S.known.survey is not None
    surveyed = survey(S)
    products = surveyed.krylov_products(rtol)
    candidates = [_candidate(S, columns, GMRES(), products)]
    if surveyed.in_an_interval:
        if surveyed.self_adjoint:
            candidates.append(_candidate(S, columns, CG(), products + 1))  # which confirms its end
        products = theory.chebyshev_products(*surveyed.spectrum, rtol)
        candidates.append(_candidate(S, columns, Chebyshev(surveyed.spectrum), products))
    if n <= LARGEST_DIRECT and S.has_entries:
        candidates.append(_candidate(S, columns, Direct()))
    bandwidth, flops = _bandwidth(S.device), _flops()
    candidates.sort(key=lambda candidate: candidate.seconds(bandwidth, flops))
    candidates = S.device.agreed(candidates)
    first, ranking = candidates[0].method, f"fastest first: {', '.join(map(str, candidates))}"
    reasons = f"{ranking}; {surveyed}{' made before' if made_before else ''}"
    yield first, reasons, 0 if made_before else len(surveyed.residuals) - 1
    if not isinstance(first, GMRES):
        yield GMRES(), "gmres: next, as it needs no bounds", 0
    if n <= LARGEST_DIRECT and not isinstance(first, Direct):
        yield Direct(), "direct: last, as products did not do", 0


def _is_known(S: Operator) -> bool:
    """Whether an earlier solve has tried S, surveyed or factorized it."""
    known = S.known
    return known.was_tried or known.survey is not None or known.factorization is not None


_bandwidth = functools.cache(tuning.bandwidth)
_flops = functools.cache(tuning.factorization_flops)


@functools.cache
def _overheads(device: Device) -> tuple[float, float]:
    """Seconds of a launch and of a wait."""
    x = device.empty(64)
    fills = lambda: [vectors.fill(x, 0.0) for _ in range(_LAUNCHES)]  # noqa: E731
    wait = tuning.seconds(device, "a wait", lambda: vectors.dot(x, x))
    return tuning.seconds(device, f"{_LAUNCHES} launches", fills) / _LAUNCHES, wait


def _candidate(S: Operator, columns: int, method: Any, products: float = 0) -> _Candidate:
    """What so many products need; or a dense factorization, where it is not there yet, and its use."""
    n = S.shape[0]
    if isinstance(method, Direct):
        factorize = 0.0 if S.known.factorization is not None else 2.0 / 3.0 * n**3
        nbytes = 16.0 * n * n  # both triangles, and S for the residual
        return _Candidate(method, 0, nbytes, 0.0, factorize + 4.0 * n * n * columns)
    moved, launches, waits = _STEPS[method.name]
    passes = math.ceil(columns / _AT_ONCE)
    nbytes = S.nbytes * passes + S.bytes_read() + 4.0 * n * columns * moved
    launch, wait = _overheads(S.device)
    overhead = passes * launches * launch + waits * wait
    return _Candidate(method, products, products * nbytes, products * overhead)
