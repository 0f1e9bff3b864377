# SPDX-License-Identifier: BSD-3-Clause
"""`auto`: choosing a method before the first step, and saying why.

Row sums tell whether the plain iteration is best. Else three Arnoldi steps from a seeded random picture, the
survey, are made once in the life of S: their Ritz values estimate the spectrum, the residuals that GMRES
would have had on the way tell how fast Krylov methods converge, and their directions whether S is
self-adjoint. Of the methods that fit, the one with the least estimated time is taken:

    products (bytes of S and of vectors / bandwidth) + launches x launch time + waits x wait time,

with bandwidth and times measured once per device.
"""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ltcl import theory
from ltcl.device import Device, tuning, vectors
from ltcl.operators import IdentityPlus, Operator
from ltcl.operators.rows import RowOperator
from ltcl.solvers import precision
from ltcl.solvers.arnoldi import Arnoldi
from ltcl.solvers.cg import CG
from ltcl.solvers.chebyshev import Chebyshev, drawn_in
from ltcl.solvers.gmres import GMRES, Hessenberg
from ltcl.solvers.precision import Direct
from ltcl.solvers.stationary import Jacobi

SMALL = 512  # pixels: below, a dense factorization takes less time than launching kernels
LARGEST_DIRECT = 8192  # pixels: above, a dense factorization takes gigabytes and minutes
PRECISE = 1e-6  # relative residual that float32 products reach for certain
STEPS = 3  # of a survey
_AT_ONCE = 8  # right-hand sides in one product
_SELF_ADJOINT = 0.02  # defect of R up to which inner products are nearly those of a self-adjoint one
_SLENDER = 0.25  # of the smallest real part: imaginary parts that an interval may leave out
# Vectors read or written, launches and waits for each product.
_STEPS = {"jacobi": (4, 1, 0.5), "chebyshev": (4, 1, 0.5), "cg": (9, 3, 0.5), "gmres": (12, 5, 1.0)}


@dataclass(frozen=True)
class Survey:
    """Estimates of the spectrum of S and of how fast methods converge.

    `ritz` are complex Ritz values; `spectrum` is an interval around their real parts, within the free bounds;
    `falls` are the relative residuals of GMRES after 0, 1, ... products, on a random picture; `defect` is the
    part of R that is not self-adjoint in the inner product of `S.weights`, or the plain one: 0 where it is, 1
    of a rotation; `products` were made to find this.
    """

    ritz: np.ndarray
    spectrum: tuple[float, float]
    falls: tuple[float, ...]
    defect: float
    products: int

    @property
    def imaginary(self) -> float:
        """Largest imaginary part."""
        return float(np.max(np.abs(np.imag(self.ritz)), initial=0.0))

    @property
    def in_an_interval(self) -> bool:
        """Whether all eigenvalues seem to lie near some interval of positive numbers."""
        least = float(np.min(np.real(self.ritz), initial=np.inf))
        return least > 0.0 and self.imaginary <= _SLENDER * least

    @property
    def self_adjoint(self) -> bool:
        """Whether cg will work as in theory."""
        return self.defect <= _SELF_ADJOINT

    def krylov_products(self, rtol: float) -> float:
        """Products of a Krylov method to `rtol`, one to confirm the end included; infinite where it stalls.

        >>> Survey(np.zeros(0), (1.0, 1.0), (1.0, 0.5, 0.1), 0.0, 2).krylov_products(0.01)
        5.0
        """
        for step, residual in enumerate(self.falls):
            if residual <= rtol:
                return step + 1.0
        factor = self.falls[-1] / self.falls[-2]
        if not factor < 1.0:
            return math.inf
        return float(len(self.falls) + math.ceil(math.log(rtol / self.falls[-1]) / math.log(factor)))

    def __str__(self) -> str:
        real = np.real(self.ritz) if len(self.ritz) else np.array([np.nan])
        turning = "" if self.in_an_interval else f" with imaginary parts up to {self.imaginary:.2g}"
        between = f"eigenvalues of S seen between {np.min(real):.2g} and {np.max(real):.2g}{turning}"
        return f"{self.defect:.2g} of R is not self-adjoint, {between} by {self.products} products"


_surveys: weakref.WeakKeyDictionary[Operator, Survey] = weakref.WeakKeyDictionary()


def survey(S: Operator) -> Survey:
    """The survey of S; products are made at the first call only."""
    if S not in _surveys:
        _surveys[S] = _explore(S)
    return _surveys[S]


def _explore(S: Operator) -> Survey:
    start = np.random.default_rng(0).uniform(size=S.shape[0])
    space = Arnoldi(S, S.device.upload(start), STEPS)
    problem, falls, columns = Hessenberg(np.ones(1)), [1.0], []
    for _ in range(min(STEPS, S.shape[0])):
        h = space.extend()
        columns.append(h[0])
        problem.extend(h)
        falls.append(float(problem.residuals[0]))
        if not h[0, -1] > 0.0:
            break
    ritz = problem.ritz_values()
    spectrum = drawn_in(theory.free_bounds(S), S, ritz)
    return Survey(ritz, spectrum, tuple(falls), _defect(S, space, columns), len(columns))


def _defect(S: Operator, space: Arnoldi, columns: list[np.ndarray]) -> float:
    """||G - G^T|| / 2 ||G|| of G = V^T W R V, from S V = V H: products that are made already."""
    steps = len(columns)
    H = np.zeros((steps + 1, steps))
    for j, column in enumerate(columns):
        H[: j + 2, j] = column
    basis = [dataclasses.replace(space.V.rows(j, 1), shape=S.shape[:1]) for j in range(steps + 1)]
    products = S.device.empty((steps * (steps + 1), 1))  # <v_i, W v_j>, read in one go
    weights = None if S.weights is None else S.device.upload(S.weights / np.max(S.weights))
    for j, v in enumerate(basis[:steps]):
        wv = v if weights is None else vectors.scale_rows(weights, v, v.like())
        for i, u in enumerate(basis):
            vectors.queue_dot(u, wv, products, j * (steps + 1) + i)
    gram = products.get().reshape(steps, steps + 1).astype(np.float64)
    G = gram @ (H - np.eye(steps + 1, steps))
    whole = 2.0 * float(np.linalg.norm(G))
    return float(np.linalg.norm(G - G.T)) / whole if whole > 0.0 else 0.0


@dataclass(frozen=True)
class Choice:
    """A method to try next, why in words, and the products that it took to know."""

    method: Any
    why: str = ""
    products: int = 0


class _Candidate(NamedTuple):
    """A method, the products it will need, and the seconds that they take, roughly."""

    method: Any
    products: float
    seconds: float

    def __str__(self) -> str:
        time = f"{1e3 * self.seconds:.2g} ms estimated"
        if not self.products:
            return f"{self.method.name}: {time}"
        return f"{self.method.name}: {self.products:g} product{'s' * (self.products != 1)} and {time}"


def plan(S: Operator, rtol: float, columns: int = 1) -> Iterator[Choice]:
    """The methods to try for S x = b to `rtol`, `columns` right-hand sides at once, in order.

    Each next one is for the case that those before failed.
    """
    n = S.shape[0]
    if n <= SMALL:
        yield Choice(Direct(), f"direct: {n} pixels are few enough for a dense factorization")
        return
    if rtol < PRECISE and n <= LARGEST_DIRECT:
        yield Choice(Direct(), f"direct: rtol={rtol:g} is below what float32 products reach")
        return
    least, _, most = theory.row_sum_range(S)
    rho = max(most - 1.0, 1.0 - least)
    if not math.isfinite(rho):
        yield Choice(GMRES(), "gmres: it needs no bounds, and row sums of S leave float32")
        return
    plain = _iterative(S, columns, Jacobi(), theory.series_products(rho, rtol))
    free = _iterative(S, columns, Chebyshev(), theory.chebyshev_products(*theory.free_bounds(S), rtol))
    if plain.products <= free.products:
        yield Choice(plain.method, f"{plain}, {free}; row sums of R are at most {rho:.2g}")
    known = S in _surveys
    found = survey(S)
    krylov = CG() if found.self_adjoint and found.in_an_interval else GMRES()
    candidates = [_iterative(S, columns, krylov, found.krylov_products(rtol)), *_factorization(S, columns)]
    if found.in_an_interval:
        products = theory.chebyshev_products(*found.spectrum, rtol)
        candidates.append(_iterative(S, columns, Chebyshev(found.spectrum), products))
    candidates.sort(key=lambda one: one.seconds)
    reasons = f"{', '.join(map(str, candidates))}; {found}{' made before' if known else ''}"
    yield Choice(candidates[0].method, reasons, 0 if known else found.products)
    if not isinstance(candidates[0].method, GMRES):
        yield Choice(GMRES(), "gmres: next, as it needs no bounds")
    yield Choice(CG(normal=True), "cg: next, on the normal equations")
    if n <= LARGEST_DIRECT and not isinstance(candidates[0].method, Direct):
        yield Choice(Direct(), "direct: last, as products did not do")


class _Machine(NamedTuple):
    """Bytes a second, seconds a launch and a wait; and operations a second of LAPACK on the host."""

    bandwidth: float
    launch: float
    wait: float
    flops: float


_machines: weakref.WeakKeyDictionary[Device, _Machine] = weakref.WeakKeyDictionary()


def _machine(device: Device) -> _Machine:
    """Of a device, measured once."""
    if device not in _machines:
        x = device.upload(np.ones(64))
        launches = tuning.seconds(device, "64 launches", lambda: [vectors.fill(x, 0.0) for _ in range(64)])
        wait = tuning.seconds(device, "a wait", lambda: vectors.dot(x, x))
        flops = tuning.factorization_flops()
        _machines[device] = _Machine(tuning.bandwidth(device), launches / 64, wait, flops)
    return _machines[device]


def _iterative(S: Operator, columns: int, method: Any, products: float) -> _Candidate:
    (moved, launches, waits), machine = _STEPS[method.name], _machine(S.device)
    passes = math.ceil(columns / _AT_ONCE)
    nbytes = S.nbytes * passes + 4.0 * S.shape[0] * columns * moved
    seconds = nbytes / machine.bandwidth + passes * launches * machine.launch + waits * machine.wait
    return _Candidate(method, products, products * seconds)


def _factorization(S: Operator, columns: int) -> list[_Candidate]:
    """A dense factorization and its use, unless S cannot be read or is too large."""
    n, R = S.shape[0], S.R if isinstance(S, IdentityPlus) else S
    if n > LARGEST_DIRECT or not isinstance(R, RowOperator):
        return []
    machine, factorize = _machine(S.device), 0.0 if precision.is_factorized(S) else 2.0 / 3.0 * n**3
    read = 16.0 * n * n / machine.bandwidth  # both triangles, and S for the residual
    return [_Candidate(Direct(), 0, (factorize + 4.0 * n * n * columns) / machine.flops + read)]
