# SPDX-License-Identifier: BSD-3-Clause
"""`invert`: A = I - S^-1 of a transport, once, so that every further frame costs one product.

R is taken in a basis that both sides share: as it is, or compressed. A is found from its
coefficients, as coefficients again. With x_R of R~, e its error, and g that of an inverse of S~ = I
+ R~ or of a compression,

    ||x~ - x|| <= ||x~ - x_R|| + ||x_R - x|| <= g ||x_R|| + e ||x|| <= (g (1 + e) + e) ||x||,

and what float32 rounds in a product, sqrt(N) units of it, is added.

`invert_coefficients` is eq. 21 with thresholds: (I + C)^-1 = I - D with D = C - D C: of C = R, D is
A. With what is left, G = C - D (I + C), Chebyshev's iteration adds gain G + keep times what was
added last: it converges for every albedo below one.

D stands left of the product, so that rows never mix: blocks of them go through it by themselves,
and only what is above a threshold is kept. G is computed from D as it is kept, so nothing that is
dropped adds up: x~ = (I - D) b is off by -G x, so relatively by ||G||_2 at most. Noise of a
measured transport is in all coefficients: then, and where the iteration fails, I + C is inverted as
a dense matrix, if there is room.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import ConvergenceError, InputError, ToleranceError
from ltcl.operators import CSR, Compressed, Dense, Host, IdentityPlus, Operator, Tiles
from ltcl.solvers import Inverse
from ltcl.solvers.chebyshev import chebyshev_rate, chebyshev_steps
from ltcl.solvers.result import Status
from ltcl.tasks.compression.coefficients import (
    INVERSE_NAMES,
    basis_names,
    drop_below,
    quantize,
    threshold_within,
)
from ltcl.tasks.compression.compress import (
    Goal,
    Note,
    compress_inputs,
    validate_progress,
    validate_rtol,
)
from ltcl.tasks.compression.losses import (
    MISS,
    UNIT,
    LinearOperator,
    Starts,
    estimate_norm,
    fresh_starts,
)
from ltcl.tasks.compression.sources import memory_errors, of_transport
from ltcl.theory import two_norm
from ltcl.transport.transport import Transport, check_transport

_FOR_R = 0.4  # of the tolerance
_ITERATION = 0.9  # of the rest, for A; the last tenth is for rounding its core
_BOUNCES = 2.0  # |b| and |A| |b|, where A takes no more light than there is
_SHARE = 0.7  # of the tolerance, that the first threshold is to cost
_FINE = 0.1  # of the threshold: what of a correction is too small to be added
_AIM, _LEAST, _MOST = (
    0.8,
    0.1,
    0.7,
)  # of the tolerance a lower threshold aims at; what it is lowered by
_GROWTH, _MAXITER = 10.0, 60  # times the first residual; products
_FILL = 1 << 22  # numbers in the product of a block of rows, about
_DENSE, _MATRICES = 64, 5  # rows: fewer are eliminated, ARPACK wants some; dense matrices at once
_WIDER, _FLAT = (
    0.02,
    1e-3,
)  # of a spectrum: room on each side; least of the upper end for the lower one


def invert(
    T: Transport,
    rtol: float = 1e-2,
    *,
    basis: str | Sequence[str] = INVERSE_NAMES,
    progress: Note | None = None,
) -> Inverse:
    """S^-1 = I - A of a transport, to be kept: see `ltcl.solvers.Inverse`.

    Parameters
    ----------
    T : Transport, square
        Measured, or compressed already; with wavelets on one side alone, or scanned adaptively, it
        is written anew first, from N products with it, and the error adds both losses.
    rtol : float
        Relative error that a solution may have, ``||x~ - x|| <= rtol ||x||`` for every picture.
    basis : str or sequence of str
        In which A and R are written, "pixels" or an orthonormal wavelet; of several, the best. A T
        that was compressed in one basis on both sides keeps it.
    progress : callable(text, share), optional
        Called as the work goes on.

    Returns
    -------
    Inverse
        Its `error` is the bound on solutions, at most `rtol`.

    Raises
    ------
    InputError
        T is not square; rtol is below what a compressed T or float32 allows; S is singular.
    ConvergenceError
        The iteration did not end: S is singular, or nearly so.
    MemoryLimitError
        R, A or their coefficients do not fit into the memory of the host.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    >>> inv = ltcl.invert(T, rtol=1e-2)
    >>> frames = 0.1 * numpy.random.default_rng(0).random((4, 8, 16)) + 0.2
    >>> c = ltcl.compensate(T, frames, inverse=inv)
    >>> c.solution.products, c.error <= 2e-2
    (1, True)
    """
    check_transport(T)
    rtol = validate_rtol(rtol, _BOUNCES * UNIT * math.sqrt(T.shape[0]))
    if T.is_compressed and rtol <= T.error:
        raise InputError(
            f"rtol is {rtol:g}, but T is compressed and its solutions may be off by "
            f"{checks.upwards(T.error)}; ask for more than that, or invert what T was compressed from"
        )
    names = basis_names(basis, for_inverse=True)
    note, starts = validate_progress(progress), fresh_starts("invert")
    bounces, errors = [], []
    try:
        with memory_errors("invert", T):
            systems, compressions = _in_one_basis(
                T, rtol, names, lambda text, share: note(text, share / 2)
            )
            for channel, S in enumerate(systems):
                begun = 0.5 + 0.5 * channel / T.channels
                A, error = _bounce(S, rtol, starts, lambda text, begun=begun: note(text, begun))
                bounces.append(A)
                errors.append(error)
        note("done", 1.0)
    except ToleranceError as error:
        least = float(checks.upwards(1.1 * error.least - 0.1 * T.error))
        message = f"rtol is {rtol:g}, but float32 reaches about {least:g} for the inverse of this T"
        raise ToleranceError(message, least) from None
    confidence = 1.0 - (compressions + T.channels + 1) * MISS
    return Inverse(bounces, errors, T.grid, T.first_bounce, T.mixing, confidence=confidence)


def _in_one_basis(
    T: Transport, rtol: float, names: list[str], note: Note
) -> tuple[tuple[Any, ...], int]:
    """S of every channel, whose R are numbers in one basis, and how many compressions are behind them."""
    compressions = 1 if T.error else 0
    if (T.is_compressed or names == ["pixels"]) and all(_has_coefficients(S.R) for S in T.systems):
        return T.systems, compressions
    share = _FOR_R * (rtol - T.error) / (1.0 + T.error)
    starts = fresh_starts("rewrite" if T.error else "compress")
    try:
        systems = compress_inputs(of_transport(T), names, Goal("worst", share), starts, note)[
            0
        ].systems
    except ToleranceError as error:
        raise ToleranceError(str(error), T.error + error.least * (1.0 + T.error) / _FOR_R) from None
    before = [S.solution_error for S in T.systems] if T.is_compressed else [0.0] * T.channels
    errors = [e + S.solution_error * (1.0 + e) for e, S in zip(before, systems, strict=True)]
    systems = [IdentityPlus(S.R, solution_error=e) for e, S in zip(errors, systems, strict=True)]
    return tuple(systems), compressions + 1


def _has_coefficients(R: Any) -> bool:
    """Whether R is numbers in pixels, or in one isometric basis on both sides."""
    between = isinstance(R, Compressed) and (R.two_sided or R.out is R.into is None)
    return isinstance(R.core if between else R, (CSR, Tiles, Dense))


def _bounce(
    S: IdentityPlus, rtol: float, starts: Starts, progress: Callable
) -> tuple[Operator, float]:
    """A of one channel, and the relative error of solutions with it."""
    R, W = (S.R.core, S.R.out) if isinstance(S.R, Compressed) else (S.R, None)
    C: Any = R.matrix() if isinstance(R, (CSR, Tiles)) else R.to_dense()
    C = scipy.sparse.csr_array(C).astype(np.float32)
    eye = scipy.sparse.eye_array(C.shape[0])
    norm = max(
        1.0, _bound(eye + C, S.device, starts)
    )  # S is the identity on coefficients that C leaves out
    earlier = S.solution_error
    rounding = UNIT * math.sqrt(S.shape[0]) * norm  # of x, for each unit of b and A b
    least = earlier + _BOUNCES * rounding
    allowance = (rtol - least) / (1.0 + earlier)
    if allowance <= 0.0:
        raise ToleranceError("nothing is left for A", least + _BOUNCES * rounding)
    try:
        inverse = invert_coefficients(
            C, rtol=_ITERATION * allowance, device=S.device, progress=progress
        )
    except ConvergenceError as failed:
        if failed.solution.status is not Status.STAGNATED:
            raise ConvergenceError(
                f"S of T was not inverted by {failed}", failed.solution
            ) from None
        least += (1.0 + earlier) * failed.solution.error / _ITERATION
        raise ToleranceError("float32 has no more digits of A", least) from None
    progress("choosing the precision of A")
    core = Tiles(S.device, quantize(inverse.D, (1.0 - _ITERATION) * allowance / norm))
    error = _bound(_residual(C, core.matrix()), S.device, starts, allowance)
    if error > allowance:
        core, error = Tiles(S.device, quantize(inverse.D, 0.0)), inverse.error
    error = error * (1.0 + earlier) + least
    # Of X = I - A~: A~ - A = (I - X S) S^-1, ||I - X S|| <= error, and so ||S^-1|| <= ||X|| / (1 -
    # error).
    size = error / (1.0 - error) * _bound(eye - core.matrix(), S.device, starts)
    return Compressed(core, W, W, error=size), error


@dataclass(frozen=True, eq=False)
class SparseInverse:
    """What `invert_coefficients` returns.

    (I + C)^-1 = I - D, D a csr_array (N, N). `error` bounds ``||I - (I - D)(I + C)||_2``: of every solution,
    relative to itself, but for two in a million over the random starts of `theory.two_norm`.
    `products` are of sparse matrices, D C each; `method` is "iteration" or "elimination".
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

    C (N, N) is sparse, of coefficients in one orthonormal basis on both sides, or of pixels. A
    solution with I - D may have the relative error `rtol`. What is beyond the iteration is
    eliminated where there is room.

    Raises
    ------
    InputError, InputTypeError
        No square sparse matrix, a singular one, or eigenvalues at or below 0 without room to
        eliminate it.
    ConvergenceError
        Divergence, or too many products, without that room; or no more digits. ``.solution`` has
        the rest.

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
    # 2 N^3 multiplications of a dense inverse move 16 bytes for each 64; those of 6 sparse products
    # 16 each.
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


def _residual(C: Any, D: Any) -> Any:
    """G = C - D (I + C), without forming it."""
    CT, DT = C.T, D.T

    def product(X: np.ndarray) -> np.ndarray:
        Y = C @ X
        return Y - D @ (X + Y)

    def transposed(X: np.ndarray) -> np.ndarray:
        Y = DT @ X
        return CT @ (X - Y) - Y

    return LinearOperator(
        C.shape, product, transposed, product, dtype=np.float64, rmatmat=transposed
    )


def _bound(A: Any, device: Device, starts: Starts, below: float | None = None) -> float:
    """Upper bound on ||A||_2; `below` is what it matters to be below."""
    return two_norm(Host(device, A), below=below, **next(starts)).upper


class _Run:
    """D on its way, and what has been seen of it."""

    def __init__(
        self, C: Any, rtol: float, device: Device, progress: Callable[[str], object]
    ) -> None:
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
            self.bound = _bound(_residual(self.C, self.D), self.device, self._starts, self.rtol)
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
                self.D, self.products = (
                    scipy.sparse.vstack(list(steps), format="csr"),
                    self.products + 1,
                )
                before, norm = norm, self.measure()
                if norm > (1.0 + rate) / 2.0 * before:
                    # What was dropped is most of the residual, or the step would have lowered it:
                    # drop less.
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
        return float(
            arpack(C, k=1, which=which, tol=1e-2, v0=start, return_eigenvectors=False)[0].real
        )
    except scipy.sparse.linalg.ArpackNoConvergence:
        norm = float(
            np.sqrt(abs(C).sum(axis=0).max() * abs(C).sum(axis=1).max())
        )  # all are inside its disc
        return norm if which == "LR" else -norm


def _row_blocks(C: Any) -> np.ndarray:
    """Where blocks of rows begin and end whose product C C has about `_FILL` numbers each."""
    n = C.shape[0]
    through = np.concatenate([[0], np.cumsum(np.diff(C.indptr)[C.indices], dtype=np.int64)])
    filled = np.cumsum(np.minimum(np.diff(through[C.indptr]), n))
    ends = np.searchsorted(filled, np.arange(_FILL, filled[-1], _FILL), side="right")
    return np.unique(np.concatenate([[0], ends, [n]]))
