# SPDX-License-Identifier: BSD-3-Clause
"""`invert_coefficients`: (I + C)^-1 = I - D for a sparse C, with D sparse as well.

This is eq. 21 with thresholds: D = C - D C; D of C = R is A. With the residual G = C - D (I + C),
Chebyshev's iteration adds gain G + keep times what was added last: it converges for every albedo
below one.

D stands left of the product, so that rows never mix: blocks of them go through it by themselves,
and only numbers above a threshold are kept. G is computed from D as it is kept, so nothing that is
dropped adds up: x~ = (I - D) b is off by -G x, so relatively by ||G||_2 at most. The noise of a
measured transport is in all coefficients: then, and where the iteration fails, I + C is inverted as
a dense matrix, if there is room.
"""

from __future__ import annotations

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
from ltcl.device import Device, open_device
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Host
from ltcl.solvers.chebyshev import chebyshev_rate, chebyshev_steps
from ltcl.solvers.result import Status
from ltcl.tasks.compression.coefficients import drop_below, threshold_within
from ltcl.tasks.compression.norms import LinearOperator, Starts, estimate_norm, fresh_starts
from ltcl.theory import two_norm

# Part of the tolerance that the first threshold is to cost.
FIRST_THRESHOLD_SHARE = 0.7
# Numbers of a correction below this part of the threshold are too small to be added.
CORRECTION_SHARE = 0.1
# Part of the tolerance that a lower threshold aims at, and the factors by which it may be lowered.
AIMED_SHARE = 0.8
MIN_THRESHOLD_FACTOR = 0.1
MAX_THRESHOLD_FACTOR = 0.7
# Times the first residual, beyond which the iteration diverges.
GROWTH_LIMIT = 10.0
MAX_PRODUCTS = 60
# Numbers in the product of a block of rows, about.
BLOCK_NUMBERS = 1 << 22
# Matrices of fewer rows are eliminated: ARPACK wants some.
MAX_SMALL_ROWS = 64
# Dense matrices that an elimination holds at once.
DENSE_MATRICES = 5
# 2 N^3 multiplications of a dense inverse move 16 bytes for each 64; those of 6 sparse products 16
# each. Elimination is faster where N^3 is below so many times the multiplications of one product.
DENSE_ADVANTAGE = 192.0
# Room on each side of the spectrum, as a part of it; smallest lower end, as a part of the upper
# one.
SPECTRUM_MARGIN = 0.02
MIN_LOWER_END = 1e-3
BISECTION_STEPS = 6


@dataclass(frozen=True, eq=False)
class SparseInverse:
    """Result of `invert_coefficients`: (I + C)^-1 = I - D.

    Attributes
    ----------
    D : csr_array, (N, N)
    error : float
        Bound on ``||I - (I - D)(I + C)||_2``: the relative error of every solution, but for a
        probability of two in a million over the random starts of `theory.two_norm`.
    status : Status
    products : int
        Number of products of sparse matrices, D C each.
    method : "iteration" or "elimination"
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
    """D of (I + C)^-1 = I - D: A from R. D of -A is R with the other sign.

    C (N, N) is sparse, of coefficients in one orthonormal basis on both sides, or of pixels. A
    solution with I - D may have the relative error `rtol`. A matrix that is beyond the iteration is
    eliminated where there is room.

    Raises
    ------
    InputError, InputTypeError
        C is no square sparse matrix, or singular, or has eigenvalues at or below 0 and no room to
        eliminate it.
    ConvergenceError
        Divergence, or too many products, without that room; or no more digits. ``.solution`` has
        the `SparseInverse` so far.

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
    rows = C.shape[0]
    if C.shape[1] != rows:
        raise InputError(f"C has shape {C.shape}; it must be square, (N, N)")
    if C.dtype not in (np.float32, np.float64):
        C = C.astype(np.float64)
    if device is None:
        device = open_device()
    inversion = _Inversion(C, rtol, device, progress)
    is_small = rows <= MAX_SMALL_ROWS
    dense_bytes = 8 * DENSE_MATRICES * rows * rows
    has_room = is_small or dense_bytes < checks.host_memory()
    multiplications = _row_products(C).sum(dtype=np.int64)
    is_dense = rows**3 < DENSE_ADVANTAGE * float(multiplications)
    status = Status.DIVERGED
    if not is_small and not (has_room and is_dense):
        try:
            status = inversion.iterate()
        except InputError:
            if not has_room:
                raise
    if has_room and status is not Status.CONVERGED:
        status = inversion.eliminate()
    if status is not Status.CONVERGED:
        inversion.measure(always=True)
    result = SparseInverse(
        D=inversion.D,
        error=inversion.bound,
        status=status,
        products=inversion.products,
        method=inversion.method,
    )
    if status is not Status.CONVERGED:
        raise ConvergenceError(
            f"{result.method}: {status.name.lower()} after {result.products} products, "
            f"error {result.error:.2g}; loosen rtol, or check the first bounce",
            result,
        )
    return result


def residual_operator(C: Any, D: Any) -> Any:
    """G = C - D (I + C) as an operator, without forming it."""
    C_transposed = C.T
    D_transposed = D.T

    def multiply(X: np.ndarray) -> np.ndarray:
        Y = C @ X
        return Y - D @ (X + Y)

    def multiply_transposed(X: np.ndarray) -> np.ndarray:
        Y = D_transposed @ X
        return C_transposed @ (X - Y) - Y

    return LinearOperator(
        C.shape,
        matvec=multiply,
        rmatvec=multiply_transposed,
        matmat=multiply,
        rmatmat=multiply_transposed,
        dtype=np.float64,
    )


def bound_norm(A: Any, device: Device, starts: Starts, below: float | None = None) -> float:
    """Upper bound on ||A||_2; only whether it is less than `below` may matter."""
    return two_norm(Host(device, A), below=below, **next(starts)).upper


class _Inversion:
    """D on its way, and what has been measured of it."""

    def __init__(
        self, C: Any, rtol: float, device: Device, progress: Callable[[str], object]
    ) -> None:
        self.C = C
        self.rtol = rtol
        self.device = device
        self.progress = progress
        self.method = "iteration"
        self.D: Any = scipy.sparse.csr_array(C.shape, dtype=C.dtype)
        self.products = 0
        self.threshold = 0.0
        self.bound = math.inf
        self._starts = fresh_starts("sparse inverse")
        # Vector of the largest residual so far.
        self._largest_vector: np.ndarray | None = None

    @property
    def has_converged(self) -> bool:
        """True if the residual is within the tolerance for certain."""
        return self.bound <= self.rtol

    def measure(self, always: bool = False) -> float:
        """Estimate the residual of D; bound it where that may be small enough, or `always`."""
        self.progress(f"{self.method}: residual after {self.products} products")
        residual = residual_operator(self.C, self.D)
        norm, vector = estimate_norm(residual, self._largest_vector)
        self._largest_vector = vector
        self.bound = math.inf
        if always or norm <= self.rtol:
            self.bound = bound_norm(residual, self.device, self._starts, self.rtol)
        return norm

    def _lower_threshold(self, norm: float) -> None:
        factor = AIMED_SHARE * self.rtol / max(norm, 1e-300)
        self.threshold *= min(max(factor, MIN_THRESHOLD_FACTOR), MAX_THRESHOLD_FACTOR)

    def iterate(self) -> Status:
        """Chebyshev's iteration, to the end."""
        norm = self.measure()
        if self.has_converged:
            return Status.CONVERGED
        first_norm = norm
        spectrum = _spectral_interval(self.C)
        weights = chebyshev_steps(*spectrum)
        rate = chebyshev_rate(*spectrum)
        self.threshold = _threshold_of_norm(self.C, FIRST_THRESHOLD_SHARE * self.rtol)
        steps = _RowSteps(self.C)
        # SciPy's products run side by side.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            while not self.has_converged:
                if not norm <= GROWTH_LIMIT * first_norm:
                    return Status.DIVERGED
                if self.products >= MAX_PRODUCTS:
                    return Status.MAXITER
                keep, gain = next(weights)
                self.D = steps.advance(self.D, keep, gain, self.threshold, pool)
                self.products += 1
                previous_norm = norm
                norm = self.measure()
                if norm > (1.0 + rate) / 2.0 * previous_norm:
                    # Dropped numbers are most of the residual, or the step would have lowered it:
                    # drop less.
                    self._lower_threshold(norm)
        return Status.CONVERGED

    def eliminate(self) -> Status:
        """A dense inverse, then a threshold, as low as it has to be."""
        self.method = "elimination"
        self.products = 0
        self._largest_vector = None
        self.progress("elimination: a dense inverse")
        eye = np.eye(self.C.shape[0])
        try:
            dense = eye - np.linalg.inv(eye + self.C.toarray())
        except np.linalg.LinAlgError:
            dense = np.full_like(eye, np.nan)
        if not np.all(np.isfinite(dense)):
            raise InputError("S = I + C is singular; check the first bounce")
        exact = scipy.sparse.csr_array(dense.astype(self.C.dtype))
        self.threshold = _threshold_of_norm(exact, FIRST_THRESHOLD_SHARE * self.rtol)
        while True:
            self.D, dropped_squares = drop_below(exact, self.threshold)
            norm = self.measure()
            if self.has_converged:
                return Status.CONVERGED
            if dropped_squares == 0.0:
                return Status.STAGNATED
            self._lower_threshold(max(norm, self.rtol))


class _RowSteps:
    """Steps of the recurrence D += d, d = gain G + keep d, by blocks of rows."""

    def __init__(self, C: Any) -> None:
        self.C = C
        eye = scipy.sparse.eye_array(C.shape[0], dtype=C.dtype)
        self.S = scipy.sparse.csr_array(eye + C)
        ends = itertools.pairwise(_row_blocks(C))
        self.blocks = [slice(start, stop) for start, stop in ends]
        # d of each block.
        self.directions: list[Any] = [None] * len(self.blocks)

    def advance(
        self, D: Any, keep: float, gain: float, threshold: float, pool: ThreadPoolExecutor
    ) -> Any:
        """D after one step, without numbers below the threshold."""

        def step(number: int) -> Any:
            rows = self.blocks[number]
            residual = scipy.sparse.csr_array(self.C[rows] - D[rows] @ self.S)
            G, _ = drop_below(residual, CORRECTION_SHARE * threshold)
            # Sums have one order, however rows are cut.
            G.sort_indices()
            direction = gain * G
            if keep:
                direction = direction + keep * self.directions[number]
            self.directions[number] = direction
            moved = scipy.sparse.csr_array(D[rows] + direction)
            return drop_below(moved, threshold)[0]

        blocks = list(pool.map(step, range(len(self.blocks))))
        return scipy.sparse.vstack(blocks, format="csr")


def _threshold_of_norm(C: Any, error: float) -> float:
    """About the largest threshold that drops no more than `error` of C in the 2-norm."""
    # A threshold within the Frobenius norm is safe, and no number above the error may go.
    low = min(threshold_within(error, C.data.astype(np.float32)), error)
    high = error
    for _ in range(BISECTION_STEPS):
        middle = math.sqrt(max(low, 1e-6 * error) * high)
        large, _ = drop_below(C, middle)
        lost, _ = estimate_norm(scipy.sparse.csr_array(C - large))
        if lost <= error:
            low = middle
        else:
            high = middle
    return low


def _spectral_interval(C: Any) -> tuple[float, float]:
    """(lower, upper) of the real parts of the eigenvalues of I + C, slightly widened.

    Light transport has nearly real eigenvalues; they are found by Arnoldi's method, on the host.
    """
    lower = 1.0 + _outermost(C, "SR")
    upper = 1.0 + _outermost(C, "LR")
    if not lower > 0.0:
        raise InputError(
            f"S = I + C has an eigenvalue of real part {lower:.3g}; all must be above 0, "
            "as those of every scene are, since memory is too small for elimination: "
            "check the first bounce"
        )
    margin = SPECTRUM_MARGIN * (upper - lower)
    least = max(lower / 2.0, MIN_LOWER_END * upper)
    return max(lower - margin, least), upper + margin


def _outermost(C: Any, which: str) -> float:
    """The smallest ("SR") or largest ("LR") real part, or a bound on it where none was found."""
    arpack: Any = scipy.sparse.linalg.eigs
    start = np.random.default_rng(0).uniform(0.5, 1.5, C.shape[0])
    start = start.astype(C.dtype)
    try:
        (value,) = arpack(C, 1, which=which, tol=1e-2, v0=start, return_eigenvectors=False)
        return float(value.real)
    except scipy.sparse.linalg.ArpackNoConvergence:
        # All eigenvalues are within a disc of this radius.
        sizes = abs(C)
        radius = float(np.sqrt(sizes.sum(axis=0).max() * sizes.sum(axis=1).max()))
        return radius if which == "LR" else -radius


def _row_blocks(C: Any) -> np.ndarray:
    """Ends of blocks of rows whose product C C has about `BLOCK_NUMBERS` numbers each."""
    rows = C.shape[0]
    products_before = np.cumsum(_row_products(C), dtype=np.int64)
    products_before = np.concatenate([[0], products_before])
    products = np.diff(products_before[C.indptr])
    numbers = np.cumsum(np.minimum(products, rows))
    block_ends = np.arange(BLOCK_NUMBERS, numbers[-1], BLOCK_NUMBERS)
    ends = np.searchsorted(numbers, block_ends, side="right")
    return np.unique(np.concatenate([[0], ends, [rows]]))


def _row_products(C: Any) -> np.ndarray:
    """Multiplications in C C for each number of C: the numbers in the row that it meets."""
    return np.diff(C.indptr)[C.indices]
