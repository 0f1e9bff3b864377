# SPDX-License-Identifier: BSD-3-Clause
"""The inverse of a sparse matrix of coefficients, as sparse coefficients again: eq. 21 with thresholds.

    bounces added    (I - A)^-1 = I + R      R = A + A R
    bounces undone   (I + R)^-1 = I - A      A = R - R A

Both are D = C - s D C, where (I + s C)^-1 = I - s D: C = R and s = 1 give A, C = A and s = -1 give R. With
what is left, G = C - D (I + s C), eq. 21 adds G to D, which converges where rho(C) < 1. Chebyshev's iteration
adds gain G + keep times what was added last, for the same product, and converges for every albedo below one.
A of a corner of albedo 0.8 takes 3 products to 1 % and 4 to 0.1 %, with eq. 21 5 and 8.

D stands left of the product, so that rows never mix: blocks of them go through it by themselves, and only
what is above a threshold is kept. G is computed from D as it is kept, so nothing that is dropped adds up:
x~ = (I - s D) b is off by -s G x, so relatively by ||G||_2 at most. Noise of a measured transport is in all
coefficients: then, and where the iteration fails, I + s C is inverted as a dense matrix, if there is room.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.compression.coefficients import Magnitudes, drop_below
from ltcl.compression.norms import MISS, Starts, estimate_norm, fresh_starts
from ltcl.device import Device, open_device
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Host
from ltcl.solvers.chebyshev import chebyshev_rate, chebyshev_steps
from ltcl.solvers.result import Status
from ltcl.theory import TwoNorm, two_norm

METHODS = ("auto", "iteration", "elimination")
_SHARE = 0.7  # of the tolerance, that the first threshold is to cost
_FINE = 0.1  # of the threshold: what of a correction is too small to be added
_AIM, _LEAST, _MOST = 0.8, 0.1, 0.7  # of the tolerance a lower threshold aims at; what it is lowered by
_GROWTH = 10.0  # times the first residual
_FILL = 1 << 22  # numbers in the product of a block of rows, about
_LARGEST, _MATRICES = 8192, 4  # rows of a dense elimination, and matrices in memory at once
_DENSE = 64  # rows: of fewer all eigenvalues are found, and ARPACK wants some
_WIDER, _FLAT = 0.02, 1e-3  # of a spectrum: room on each side; least of the upper end for the lower one


@dataclass(frozen=True, eq=False)
class SparseInverse:
    """What `invert_coefficients` returns.

    (I + sign C)^-1 = I - sign D, D a csr_array (N, N) of numbers of at least `threshold`. `error` bounds
    ``||I - (I - sign D)(I + sign C)||_2``: of every solution, relative to itself, with `confidence` over the
    random starts of `theory.two_norm`. `products` are of sparse matrices, D C each; `method` is "iteration"
    or "elimination".
    """

    D: Any
    error: float
    confidence: float
    status: Status
    products: int
    threshold: float
    method: str

    @property
    def converged(self) -> bool:
        """Whether the bound is within the tolerance."""
        return self.status is Status.CONVERGED

    def __str__(self) -> str:
        n = self.D.shape[0]
        advice = "" if self.converged else "; loosen rtol, raise maxiter, or try method='elimination'"
        return (
            f"{self.method}: {self.status.name.lower()} after {self.products} products, "
            f"error {self.error:.2g}, {self.D.nnz / n:.3g} numbers a row{advice}"
        )


def invert_coefficients(
    C: Any,
    sign: float = 1.0,
    *,
    rtol: float = 1e-2,
    method: str = "auto",
    maxiter: int = 60,
    device: Device | None = None,
) -> SparseInverse:
    """D of (I + sign C)^-1 = I - sign D: A from R, or R from A with ``sign=-1``.

    C (N, N) is sparse, of coefficients in one orthonormal basis on both sides, or of pixels. A solution with
    I - sign D may have the relative error `rtol`, for every right-hand side. `method` is "iteration", of at
    most `maxiter` products; "elimination", dense, on the host; or "auto": the iteration, and elimination,
    where there is room, of what it cannot invert or is too full for it.

    Raises
    ------
    InputError, InputTypeError
        No square sparse matrix, a singular one, or eigenvalues at or below 0 by the iteration.
    ConvergenceError
        Divergence, or `maxiter` reached; ``.solution`` holds what there is.

    Examples
    --------
    >>> import scipy.sparse
    >>> A = scipy.sparse.csr_array([[0.0, 0.5], [0.5, 0.0]])
    >>> R = invert_coefficients(A, -1, rtol=1e-4).D
    >>> R.toarray().round(2).tolist()
    [[0.33, 0.67], [0.67, 0.33]]
    >>> invert_coefficients(R, rtol=1e-3).D.toarray().round(2).tolist()  # and back
    [[0.0, 0.5], [0.5, 0.0]]
    """
    rtol = checks.number("rtol", rtol, above=0.0, below=1.0)
    maxiter = checks.count("maxiter", maxiter)
    if sign not in (1.0, -1.0):
        raise InputError(f"sign is {sign!r}; it must be 1 for I + C or -1 for I - C")
    checks.one_of("method", method, METHODS)
    C = checks.csr("C", C)
    n = C.shape[0]
    if C.shape[1] != n:
        raise InputError(f"C has shape {C.shape}; it must be square, (N, N)")
    C = C if C.dtype in (np.float32, np.float64) else C.astype(np.float64)
    run = _Run(C, float(sign), rtol, device if device is not None else open_device())
    may_eliminate = method == "auto" and n <= _LARGEST and 8 * _MATRICES * n * n < checks.host_memory()
    if method == "elimination" or (may_eliminate and _moves_less_dense(C)):
        status = run.eliminate()
    else:
        try:
            status = run.iterate(maxiter)
        except InputError:
            if not may_eliminate:
                raise
            status = Status.DIVERGED
        if may_eliminate and status is not Status.CONVERGED:
            status = run.eliminate()
    bound = run.bound if run.bound < math.inf else run.certify()
    result = SparseInverse(run.D, bound, 1.0 - MISS, status, run.products, run.threshold, run.method)
    if not result.converged:
        raise ConvergenceError(str(result), result)
    return result


class _Residual(scipy.sparse.linalg.LinearOperator):
    """G = C - D (I + sign C), without forming it."""

    def __init__(self, C: Any, D: Any, sign: float) -> None:
        super().__init__(np.float64, C.shape)
        self.C, self.D, self.CT, self.DT, self.sign = C, D, C.T, D.T, sign

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        Y = self.C @ X
        return Y - self.D @ (X + self.sign * Y)

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        Y = self.DT @ X
        return self.CT @ (X - self.sign * Y) - Y


def residual_norm(C: Any, D: Any, sign: float, device: Device, below: float, starts: Starts) -> TwoNorm:
    """||C - D (I + sign C)||_2 with its upper bound; `below` is what it matters to be below."""
    return two_norm(Host(device, _Residual(C, D, sign)), below=below, **next(starts))


class _Run:
    """D on its way, and what has been seen of it."""

    def __init__(self, C: Any, sign: float, rtol: float, device: Device) -> None:
        self.C, self.sign, self.rtol, self.device, self.method = C, sign, rtol, device, "iteration"
        self.D: Any = scipy.sparse.csr_array(C.shape, dtype=C.dtype)
        self.products, self.threshold, self.bound = 0, 0.0, math.inf
        self._starts = fresh_starts("sparse inverse")
        self._witness: np.ndarray | None = None  # of the largest residual so far

    def certify(self) -> float:
        """A bound on the residual of D."""
        return residual_norm(self.C, self.D, self.sign, self.device, self.rtol, self._starts).upper

    def _look(self) -> float:
        """An estimate of the residual of D, and its bound where that may be small enough."""
        norm, self._witness = estimate_norm(_Residual(self.C, self.D, self.sign), self._witness)
        self.bound = self.certify() if norm <= self.rtol else math.inf
        return norm

    def _lower_threshold(self, norm: float) -> None:
        self.threshold *= min(max(_AIM * self.rtol / max(norm, 1e-300), _LEAST), _MOST)

    def iterate(self, maxiter: int) -> Status:
        """Chebyshev's iteration, to the end."""
        C, spectrum = self.C, _spectral_interval(self.C, self.sign)
        S = scipy.sparse.csr_array(
            scipy.sparse.eye_array(C.shape[0], dtype=C.dtype) + C.dtype.type(self.sign) * C
        )
        blocks = list(itertools.pairwise(_row_blocks(C)))
        added: list[Any] = [None] * len(blocks)  # d of the recurrence
        weights, rate = chebyshev_steps(*spectrum), chebyshev_rate(*spectrum)
        self.threshold = _threshold_within(C, _SHARE * self.rtol)
        norm = first = self._look()

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
                if self.products >= maxiter:
                    return Status.MAXITER
                steps = pool.map(functools.partial(step, *next(weights)), range(len(blocks)))
                self.D, self.products = scipy.sparse.vstack(list(steps), format="csr"), self.products + 1
                before, norm = norm, self._look()
                if norm > (1.0 + rate) / 2.0 * before:
                    # What was dropped is most of the residual, or the step would have lowered it: drop less.
                    self._lower_threshold(norm)
        return Status.CONVERGED

    def eliminate(self) -> Status:
        """A dense inverse, then a threshold, as low as it has to be."""
        self.method, self.products, self._witness = "elimination", 0, None
        sign, here = self.sign, np.diag_indices(self.C.shape[0])
        inverse = sign * self.C.toarray().astype(np.float64)
        inverse[here] += 1.0
        try:
            inverse = np.linalg.inv(inverse)
        except np.linalg.LinAlgError:
            inverse[:] = np.nan
        if not np.all(np.isfinite(inverse)):
            raise InputError(f"S = I {'+' if sign > 0 else '-'} C is singular; check the first bounce")
        inverse *= -sign
        inverse[here] += sign
        exact = scipy.sparse.csr_array(inverse.astype(self.C.dtype))
        self.threshold = _threshold_within(exact, _SHARE * self.rtol)
        while True:
            self.D, lost = drop_below(exact, self.threshold)
            norm = self._look()
            if self.bound <= self.rtol:
                return Status.CONVERGED
            if lost == 0.0:
                return Status.STAGNATED
            self._lower_threshold(max(norm, self.rtol))


def _threshold_within(C: Any, error: float) -> float:
    """About the largest threshold that drops no more than `error` of C in the 2-norm."""
    # What the Frobenius norm allows is safe, and no number above the error may go.
    low, high = min(Magnitudes.of(C.data.astype(np.float32)).threshold(error), error), error
    for _ in range(6):
        middle = math.sqrt(max(low, 1e-6 * error) * high)
        lost = estimate_norm(scipy.sparse.csr_array(C - drop_below(C, middle)[0]))[0]
        low, high = (middle, high) if lost <= error else (low, middle)
    return low


def _spectral_interval(C: Any, sign: float) -> tuple[float, float]:
    """(lower, upper) of the real parts of the eigenvalues of I + sign C, slightly widened.

    Light transport has nearly real eigenvalues; they are found by Arnoldi's method, on the host.
    """
    if C.nnz == 0:
        return 1.0, 1.0
    if C.shape[0] <= _DENSE:
        values = np.linalg.eigvals(C.toarray().astype(np.float64)).real
        ends = (float(values.min()), float(values.max()))
    else:
        ends = (_outermost(C, "SR"), _outermost(C, "LR"))
    lower, upper = sorted(1.0 + sign * end for end in ends)
    if not lower > 0.0:
        raise InputError(
            f"S = I {'+' if sign > 0 else '-'} C has an eigenvalue of real part {lower:.3g}; all must "
            "be above 0, as of every scene: check the first bounce, or give method='elimination'"
        )
    room = _WIDER * (upper - lower)
    return max(lower - room, lower / 2.0, _FLAT * upper), upper + room


def _outermost(C: Any, which: str) -> float:
    """The smallest ("SR") or largest ("LR") real part; of a run that did not settle, what it has found."""
    arpack: Any = scipy.sparse.linalg.eigs
    start = np.random.default_rng(0).uniform(0.5, 1.5, C.shape[0]).astype(C.dtype)
    try:
        values = arpack(C, k=1, which=which, tol=1e-2, v0=start, return_eigenvectors=False)
    except scipy.sparse.linalg.ArpackNoConvergence as stopped:
        values = stopped.eigenvalues
    if len(values):
        return float(np.real(values[0]))
    norm = float(np.sqrt(abs(C).sum(axis=0).max() * abs(C).sum(axis=1).max()))  # all are inside its disc
    return norm if which == "LR" else -norm


def _row_blocks(C: Any) -> np.ndarray:
    """Where blocks of rows begin and end whose product C C has about `_FILL` numbers each."""
    n = C.shape[0]
    through = np.concatenate([[0], np.cumsum(np.diff(C.indptr)[C.indices], dtype=np.int64)])
    filled = np.cumsum(np.minimum(np.diff(through[C.indptr]), n))
    ends = np.searchsorted(filled, np.arange(_FILL, filled[-1], _FILL), side="right")
    return np.unique(np.concatenate([[0], ends, [n]]))


def _moves_less_dense(C: Any) -> bool:
    """Whether elimination moves fewer bytes than 6 sparse products.

    2 N^3 multiplications, in blocks, take 16 bytes for each 64; sparse ones take as many each.
    """
    multiplications = float(np.diff(C.indptr)[C.indices].sum(dtype=np.int64))
    return 2.0 * C.shape[0] ** 3 * 16.0 / 64.0 < 6 * 16.0 * multiplications
