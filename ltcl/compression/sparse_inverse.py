# SPDX-License-Identifier: BSD-3-Clause
"""The inverse of a sparse matrix of coefficients, as sparse coefficients again: eq. 21 with thresholds.

(I + C)^-1 = I - D with D = C - D C: of C = R, D is A. With what is left, G = C - D (I + C), Chebyshev's
iteration adds gain G + keep times what was added last: it converges for every albedo below one.

D stands left of the product, so that rows never mix: blocks of them go through it by themselves, and only
what is above a threshold is kept. G is computed from D as it is kept, so nothing that is dropped adds up:
x~ = (I - D) b is off by -G x, so relatively by ||G||_2 at most. Noise of a measured transport is in all
coefficients: then, and where the iteration fails, I + C is inverted as a dense matrix, if there is room.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.compression.coefficients import drop_below, threshold_within
from ltcl.compression.norms import Starts, estimate_norm, fresh_starts
from ltcl.device import Device, open_device
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Host
from ltcl.solvers.result import Status
from ltcl.solvers.stationary import chebyshev_rate, chebyshev_steps
from ltcl.theory import two_norm

_SHARE = 0.7  # of the tolerance, that the first threshold is to cost
_FINE = 0.1  # of the threshold: what of a correction is too small to be added
_AIM, _LEAST, _MOST = 0.8, 0.1, 0.7  # of the tolerance a lower threshold aims at; what it is lowered by
_GROWTH, _MAXITER = 10.0, 60  # times the first residual; products
_FILL = 1 << 22  # numbers in the product of a block of rows, about
_DENSE, _MATRICES = 64, 5  # rows: fewer are eliminated, ARPACK wants some; dense matrices at once
_WIDER, _FLAT = 0.02, 1e-3  # of a spectrum: room on each side; least of the upper end for the lower one


@dataclass(frozen=True, eq=False)
class SparseInverse:
    """What `invert_coefficients` returns.

    (I + C)^-1 = I - D, D a csr_array (N, N). `error` bounds ``||I - (I - D)(I + C)||_2``: of every solution,
    relative to itself, but for two in a million over the random starts of `theory.two_norm`. `products` are
    of sparse matrices, D C each; `method` is "iteration" or "elimination".
    """

    D: Any
    error: float
    status: Status
    products: int
    method: str


def invert_coefficients(
    C: Any,
    *,
    rtol: float = 1e-2,
    device: Device | None = None,
    progress: Callable[[str], object] = lambda text: None,
) -> SparseInverse:
    """D of (I + C)^-1 = I - D: A from R. R is what -A has, with the other sign.

    C (N, N) is sparse, of coefficients in one orthonormal basis on both sides, or of pixels. A solution with
    I - D may have the relative error `rtol`. What is beyond the iteration is eliminated where there is room.

    Raises
    ------
    InputError, InputTypeError
        No square sparse matrix, a singular one, or eigenvalues at or below 0 without room to eliminate it.
    ConvergenceError
        Divergence, or too many products, without that room; or no more digits. ``.solution`` has the rest.

    Examples
    --------
    >>> import scipy.sparse
    >>> A = scipy.sparse.csr_array([[0.0, 0.5], [0.5, 0.0]])
    >>> R = -invert_coefficients(-A, rtol=1e-4).D
    >>> R.toarray().round(2).tolist()
    [[0.33, 0.67], [0.67, 0.33]]
    >>> invert_coefficients(R, rtol=1e-3).D.toarray().round(2).tolist()  # and back
    [[0.0, 0.5], [0.5, 0.0]]
    """
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    C = checks.csr("C", C)
    n = C.shape[0]
    if C.shape[1] != n:
        raise InputError(f"C has shape {C.shape}; it must be square, (N, N)")
    C = C if C.dtype in (np.float32, np.float64) else C.astype(np.float64)
    run = _Run(C, rtol, device if device is not None else open_device(), progress)
    has_room = n <= _DENSE or 8 * _MATRICES * n * n < checks.host_memory()
    # 2 N^3 multiplications of a dense inverse move 16 bytes for each 64; those of 6 sparse products 16 each.
    multiplications = float(np.diff(C.indptr)[C.indices].sum(dtype=np.int64))
    status = Status.DIVERGED
    if n > _DENSE and not (has_room and n**3 < 192.0 * multiplications):
        try:
            status = run.iterate()
        except InputError:
            if not has_room:
                raise
    if has_room and status is not Status.CONVERGED:
        status = run.eliminate()
    if status is not Status.CONVERGED:
        run.measure(always=True)
    result = SparseInverse(run.D, run.bound, status, run.products, run.method)
    if status is not Status.CONVERGED:
        what = f"{run.method}: {status.name.lower()} after {run.products} products, error {run.bound:.2g}"
        raise ConvergenceError(f"{what}; loosen rtol, or check the first bounce", result)
    return result


def _residual(C: Any, D: Any) -> scipy.sparse.linalg.LinearOperator:
    """G = C - D (I + C), without forming it."""
    operator: Any = scipy.sparse.linalg.LinearOperator
    CT, DT = C.T, D.T

    def product(X: np.ndarray) -> np.ndarray:
        Y = C @ X
        return Y - D @ (X + Y)

    def transposed(X: np.ndarray) -> np.ndarray:
        Y = DT @ X
        return CT @ (X - Y) - Y

    return operator(C.shape, product, transposed, product, dtype=np.float64, rmatmat=transposed)


def residual_norm(C: Any, D: Any, device: Device, below: float, starts: Starts) -> float:
    """Upper bound on ||C - D (I + C)||_2; `below` is what it matters to be below."""
    return two_norm(Host(device, _residual(C, D)), below=below, **next(starts)).upper


class _Run:
    """D on its way, and what has been seen of it."""

    def __init__(self, C: Any, rtol: float, device: Device, progress: Callable[[str], object]) -> None:
        self.progress = progress
        self.C, self.rtol, self.device, self.method = C, rtol, device, "iteration"
        self.D: Any = scipy.sparse.csr_array(C.shape, dtype=C.dtype)
        self.products, self.threshold, self.bound = 0, 0.0, math.inf
        self._starts = fresh_starts("sparse inverse")
        self._witness: np.ndarray | None = None  # of the largest residual so far

    def measure(self, always: bool = False) -> float:
        """An estimate of the residual of D, and its bound where that may be small enough, or `always`."""
        self.progress(f"{self.method}: residual after {self.products} products")
        norm, self._witness = estimate_norm(_residual(self.C, self.D), self._witness)
        self.bound = math.inf
        if always or norm <= self.rtol:
            self.bound = residual_norm(self.C, self.D, self.device, self.rtol, self._starts)
        return norm

    def _lower_threshold(self, norm: float) -> None:
        self.threshold *= min(max(_AIM * self.rtol / max(norm, 1e-300), _LEAST), _MOST)

    def iterate(self) -> Status:
        """Chebyshev's iteration, to the end."""
        C, norm = self.C, self.measure()
        if self.bound <= self.rtol:
            return Status.CONVERGED
        first, spectrum = norm, _spectral_interval(C)
        S = scipy.sparse.csr_array(scipy.sparse.eye_array(C.shape[0], dtype=C.dtype) + C)
        blocks = list(itertools.pairwise(_row_blocks(C)))
        added: list[Any] = [None] * len(blocks)  # d of the recurrence
        weights, rate = chebyshev_steps(*spectrum), chebyshev_rate(*spectrum)
        self.threshold = _threshold_of_norm(C, _SHARE * self.rtol)

        def step(keep: float, gain: float, place: int) -> Any:
            rows = slice(*blocks[place])
            D = self.D[rows]
            G, _ = drop_below(scipy.sparse.csr_array(C[rows] - D @ S), _FINE * self.threshold)
            G.sort_indices()  # so that sums have one order, however rows are cut
            added[place] = gain * G + keep * added[place] if keep else gain * G
            return drop_below(scipy.sparse.csr_array(D + added[place]), self.threshold)[0]

        with ThreadPoolExecutor(os.cpu_count()) as pool:  # SciPy's products run side by side
            while self.bound > self.rtol:
                if not norm <= _GROWTH * first:
                    return Status.DIVERGED
                if self.products >= _MAXITER:
                    return Status.MAXITER
                steps = pool.map(functools.partial(step, *next(weights)), range(len(blocks)))
                self.D, self.products = scipy.sparse.vstack(list(steps), format="csr"), self.products + 1
                before, norm = norm, self.measure()
                if norm > (1.0 + rate) / 2.0 * before:
                    # What was dropped is most of the residual, or the step would have lowered it: drop less.
                    self._lower_threshold(norm)
        return Status.CONVERGED

    def eliminate(self) -> Status:
        """A dense inverse, then a threshold, as low as it has to be."""
        self.method, self.products, self._witness = "elimination", 0, None
        self.progress("elimination: a dense inverse")
        eye = np.eye(self.C.shape[0])
        try:
            dense = eye - np.linalg.inv(eye + self.C.toarray())
        except np.linalg.LinAlgError:
            dense = np.full_like(eye, np.nan)
        if not np.all(np.isfinite(dense)):
            raise InputError("S = I + C is singular; check the first bounce")
        exact = scipy.sparse.csr_array(dense.astype(self.C.dtype))
        self.threshold = _threshold_of_norm(exact, _SHARE * self.rtol)
        while True:
            self.D, lost = drop_below(exact, self.threshold)
            norm = self.measure()
            if self.bound <= self.rtol:
                return Status.CONVERGED
            if lost == 0.0:
                return Status.STAGNATED
            self._lower_threshold(max(norm, self.rtol))


def _threshold_of_norm(C: Any, error: float) -> float:
    """About the largest threshold that drops no more than `error` of C in the 2-norm."""
    # What the Frobenius norm allows is safe, and no number above the error may go.
    low, high = min(threshold_within(error, C.data.astype(np.float32)), error), error
    for _ in range(6):
        middle = math.sqrt(max(low, 1e-6 * error) * high)
        lost = estimate_norm(scipy.sparse.csr_array(C - drop_below(C, middle)[0]))[0]
        low, high = (middle, high) if lost <= error else (low, middle)
    return low


def _spectral_interval(C: Any) -> tuple[float, float]:
    """(lower, upper) of the real parts of the eigenvalues of I + C, slightly widened.

    Light transport has nearly real eigenvalues; they are found by Arnoldi's method, on the host.
    """
    lower, upper = 1.0 + _outermost(C, "SR"), 1.0 + _outermost(C, "LR")
    if not lower > 0.0:
        raise InputError(
            f"S = I + C has an eigenvalue of real part {lower:.3g}; all must be above 0, as of every scene, "
            "where memory is too small for elimination: check the first bounce"
        )
    room = _WIDER * (upper - lower)
    return max(lower - room, lower / 2.0, _FLAT * upper), upper + room


def _outermost(C: Any, which: str) -> float:
    """The smallest ("SR") or largest ("LR") real part, or a bound on it where none was found."""
    arpack: Any = scipy.sparse.linalg.eigs
    start = np.random.default_rng(0).uniform(0.5, 1.5, C.shape[0]).astype(C.dtype)
    try:
        return float(arpack(C, k=1, which=which, tol=1e-2, v0=start, return_eigenvectors=False)[0].real)
    except scipy.sparse.linalg.ArpackNoConvergence:
        norm = float(np.sqrt(abs(C).sum(axis=0).max() * abs(C).sum(axis=1).max()))  # all are inside its disc
        return norm if which == "LR" else -norm


def _row_blocks(C: Any) -> np.ndarray:
    """Where blocks of rows begin and end whose product C C has about `_FILL` numbers each."""
    n = C.shape[0]
    through = np.concatenate([[0], np.cumsum(np.diff(C.indptr)[C.indices], dtype=np.int64)])
    filled = np.cumsum(np.minimum(np.diff(through[C.indptr]), n))
    ends = np.searchsorted(filled, np.arange(_FILL, filled[-1], _FILL), side="right")
    return np.unique(np.concatenate([[0], ends, [n]]))
