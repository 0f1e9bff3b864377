# SPDX-License-Identifier: BSD-3-Clause
"""C = W_out R W_in^T between two bases, without its small numbers.

Where the host has room for all of C, one threshold is taken of it. Else blocks of rows stream
through W_in, numbers below a first threshold are dropped, and blocks of columns stream through
W_out. Both bases are orthonormal: the error of R in the Frobenius norm is at most the sum of what
both passes drop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.operators import smallest
from ltcl.operators.tiles import Packed
from ltcl.tasks.compression.norms import estimate_norm
from ltcl.tasks.compression.sources import COLUMNS, SourceRows, cut, source

# (N, k) float32 -> (N, k) float32, k a multiple of COLUMNS.
Transform = Callable[[np.ndarray], np.ndarray]
Progress = Callable[[float], object]

# Rows of a dense block that stay in the cache while they are looked at several times.
CACHED_ROWS = 512
# Bits of a float32 that a bin of `threshold_within` leaves open.
BIN_BITS = 16
# Numbers that are counted at once.
NUMBERS_AT_ONCE = 1 << 22
# Bytes of a number that is kept: 8, and up to twice as many for a while.
BYTES_PER_NUMBER = 16
# Room for rounding of sums in comparing squares.
SQUARE_TOLERANCE = 1e-12


def quantize(C: scipy.sparse.csr_array, allowance: float) -> Packed:
    """C in the tiles of fewest bytes whose rounding has a 2-norm of at most about `allowance`.

    That norm is estimated; whoever hands out the tiles measures their error.
    """
    size = float(np.linalg.norm(C.data.astype(np.float64)))
    rows = len(C.indptr) - 1
    # The 2-norm of rounding is far below its Frobenius norm, which is that of equal rows at most.
    frobenius = allowance * math.sqrt(rows)
    while True:
        allowed = 0.0
        if size:
            allowed = frobenius / size
        packed = smallest(C, allowed)
        frobenius_of_rounding, norm_of_rounding = packed.difference
        if packed.precision == "float32" or norm_of_rounding <= allowance:
            return packed
        rounding = scipy.sparse.csr_array(packed.matrix() - C)
        if estimate_norm(rounding)[0] <= allowance:
            return packed
        frobenius = 0.5 * frobenius_of_rounding


def drop_below(X: Any, threshold: float) -> tuple[scipy.sparse.csr_array, float]:
    """Numbers of X, dense or CSR, of at least `threshold`, and the sum of squares of the others."""
    if scipy.sparse.issparse(X):
        return _drop_below_sparse(X, threshold)
    counts = [np.zeros(1, np.int64)]
    indices = []
    values = []
    squares = []
    for start, stop in cut(len(X), CACHED_ROWS):
        block = np.ascontiguousarray(X[start:stop])
        is_kept = (np.abs(block) >= threshold) & (block != 0.0)
        places = np.flatnonzero(is_kept)
        counts.append(np.count_nonzero(is_kept, axis=1))
        indices.append((places % block.shape[1]).astype(np.int32))
        values.append(block.flat[places])
        dropped = block.astype(np.float64)
        dropped.flat[places] = 0.0
        squares.append(float(np.vdot(dropped, dropped)))
    pointers = np.cumsum(np.concatenate(counts))
    csr = (np.concatenate(values), np.concatenate(indices), pointers)
    return scipy.sparse.csr_array(csr, X.shape), math.fsum(squares)


def _drop_below_sparse(X: Any, threshold: float) -> tuple[scipy.sparse.csr_array, float]:
    is_kept = np.abs(X.data) >= threshold
    dropped = X.data[~is_kept].astype(np.float64)
    kept_before = np.concatenate([[0], np.cumsum(is_kept)])
    pointers = kept_before.astype(X.indptr.dtype)[X.indptr]
    csr = (X.data[is_kept], X.indices[is_kept], pointers)
    return scipy.sparse.csr_array(csr, X.shape), float(dropped @ dropped)


def threshold_within(frobenius: float, *arrays: np.ndarray, most: float = math.inf) -> float:
    """The largest threshold below which float32 arrays have at most a Frobenius norm.

    It is larger where that leaves more than `most` numbers. Nothing is sorted: numbers are counted
    in bins of less than a percent, of the same exponent and first seven bits behind it, and the
    threshold is an edge of a bin.
    """
    bins = 1 << (32 - BIN_BITS - 1)
    counts = np.zeros(bins, np.int64)
    squares = np.zeros(bins)
    for array in arrays:
        flat = np.ravel(array)
        for start, stop in cut(flat.size, NUMBERS_AT_ONCE):
            sizes = np.abs(flat[start:stop])
            keys = sizes.view(np.int32) >> BIN_BITS
            counts += np.bincount(keys, minlength=bins)
            powers = np.square(sizes, dtype=np.float64)
            squares += np.bincount(keys, powers, minlength=bins)
    largest_square = frobenius**2 * (1 + SQUARE_TOLERANCE)
    edge = np.searchsorted(np.cumsum(squares), largest_square, side="right")
    # No edge is above the bin of the largest number.
    edge = min(int(edge), int(np.max(np.flatnonzero(counts) + 1, initial=0)))
    numbers_from_bin = np.cumsum(counts[::-1])[::-1]
    edge_of_most = np.searchsorted(-numbers_from_bin, -most, side="left")
    edge = max(edge, int(edge_of_most))
    return float(np.int32(edge << BIN_BITS).view(np.float32))


@dataclass(frozen=True, kw_only=True)
class Coefficients:
    """The numbers of R between two bases of at least `threshold`: R~ = W_out^T core W_in.

    With weights of columns, this R~ is the weighted R; `Bases` takes the weights off again.

    `first` is the Frobenius norm of what was dropped between the passes, `second` of what was
    dropped at the end.
    """

    core: scipy.sparse.csr_array
    first: float
    second: float
    threshold: float

    @property
    def dropped(self) -> float:
        """||R~ - R||_F, or a bound on it: what both passes drop may add up."""
        return self.first + self.second

    def largest(self, drop: float) -> Coefficients:
        """The largest of them, so that all in all about the Frobenius norm `drop` is left out."""
        room = max(drop**2 - self.dropped**2, 0.0)
        threshold = threshold_within(math.sqrt(room), self.core.data)
        if threshold <= self.threshold:
            return self
        core, squares = drop_below(self.core, threshold)
        second = math.sqrt(self.second**2 + squares)
        return replace(self, core=core, second=second, threshold=threshold)


def coefficients(
    R: SourceRows,
    out: Transform | None,
    into: Transform | None,
    threshold: float | None = None,
    *,
    drop: float = 0.0,
    most: float = math.inf,
    first: float | None = None,
    progress: Progress = lambda share: None,
) -> Coefficients:
    """C = W_out R W_in^T without what is below a threshold.

    Parameters
    ----------
    R : SourceRows, (M, N)
    out, into : callable or None
        Orthonormal W_out of (M, k) and W_in of (N, k) numbers; None is pixels.
    threshold : float, optional
        By default the largest that drops no more than the Frobenius norm `drop`, or a larger one
        where that keeps more than `most` numbers.
    first : float, optional
        Threshold between the two passes. By default 0 where the host has room for all numbers
        twice, else one that drops about a third of `drop`, or more.
    progress : callable(share)

    Returns
    -------
    Coefficients
        The core has the same bits for any `R.memory` and `R.client`.
    """
    m, n = R.shape
    room = checks.host_memory() // 2
    if first is None and 4 * m * n <= room:
        return _dense_coefficients(R, out, into, threshold, drop, most, progress)
    room_for_numbers = room // BYTES_PER_NUMBER
    most = min(most, room_for_numbers)
    if out is None:
        collected = _collect(R, into, threshold, drop, most, progress)
        return Coefficients(
            core=collected.core, first=0.0, second=collected.lost, threshold=collected.threshold
        )

    def progress_of_rows(share: float) -> None:
        progress(0.5 * share)

    def progress_of_columns(share: float) -> None:
        progress(0.5 + 0.5 * share)

    between = _collect(R, into, first, drop / 3.0, room_for_numbers, progress_of_rows)
    columns = scipy.sparse.csr_array(between.core.T)
    # Where light is smooth, few columns are lit.
    lit = np.flatnonzero(np.diff(columns.indptr))
    lit_columns = source("C", columns[lit], R.memory, R.client)
    collected = _collect(lit_columns, out, threshold, drop, most, progress_of_columns)
    core = scipy.sparse.csr_array(collected.core.T)
    indices = lit.astype(core.indices.dtype)[core.indices]
    core = scipy.sparse.csr_array((core.data, indices, core.indptr), (m, n))
    return Coefficients(
        core=core, first=between.lost, second=collected.lost, threshold=collected.threshold
    )


def _dense_coefficients(
    R: SourceRows,
    out: Transform | None,
    into: Transform | None,
    threshold: float | None,
    drop: float,
    most: float,
    progress: Progress,
) -> Coefficients:
    """`coefficients` where all numbers fit into memory."""
    m, n = R.shape
    C = np.empty((m, n), np.float32)

    def transform(place: slice, rows: np.ndarray, value: Any) -> tuple[slice, Any]:
        return place, _transformed(into, rows.T).T

    for place, rows in R.map_blocks(transform):
        C[place] = rows
        progress(0.5 * place.stop / m)
    if out is not None:
        for start, stop in cut(n, CACHED_ROWS):
            C[:, start:stop] = _transformed(out, C[:, start:stop])
    if threshold is None:
        threshold = threshold_within(drop, C, most=most)
    core, squares = drop_below(C, threshold)
    progress(1.0)
    return Coefficients(core=core, first=0.0, second=math.sqrt(squares), threshold=threshold)


@dataclass(frozen=True)
class _Collected:
    """The large numbers of R W^T, the Frobenius norm of what was lost, and the threshold."""

    core: scipy.sparse.csr_array
    lost: float
    threshold: float


def _collect(
    R: SourceRows,
    W: Transform | None,
    threshold: float | None,
    drop: float,
    most: float,
    progress: Progress,
) -> _Collected:
    """R W^T without what is below a threshold.

    A threshold that is not given rises whenever twice as many numbers as `most` have come together,
    never above what all of them call for.
    """
    numbers = _KeptNumbers(R.shape[1])
    if threshold is not None:
        numbers.threshold = threshold

    def drop_small(
        place: slice, rows: np.ndarray, least: float
    ) -> tuple[int, scipy.sparse.csr_array, float]:
        core, squares = drop_below(_transformed(W, rows.T), least)
        return place.stop, scipy.sparse.csr_array(core.T), squares

    for stop, piece, squares in R.map_blocks(drop_small, lambda: numbers.threshold):
        numbers.append(piece, squares)
        if threshold is None and numbers.count > 2 * most:
            numbers.raise_threshold(0.0, most)
        progress(stop / R.shape[0])
    if threshold is None:
        room = max(drop**2 - numbers.squares, 0.0)
        numbers.raise_threshold(math.sqrt(room), most)
    core = scipy.sparse.csr_array(scipy.sparse.vstack(numbers.pieces, format="csr"))
    return _Collected(core, math.sqrt(numbers.squares), numbers.threshold)


class _KeptNumbers:
    """Pieces of a sparse matrix that come together, above a threshold that rises."""

    def __init__(self, columns: int) -> None:
        self.threshold = 0.0
        self.squares = 0.0  # of what was dropped
        self.pieces: list[Any] = [scipy.sparse.csr_array((0, columns), dtype=np.float32)]

    @property
    def count(self) -> int:
        """Numbers in all pieces."""
        return sum(piece.nnz for piece in self.pieces)

    def append(self, piece: scipy.sparse.csr_array, squares: float) -> None:
        """Add a piece, of which numbers with these `squares` were dropped."""
        self.pieces.append(piece)
        self.squares += squares

    def raise_threshold(self, frobenius: float, most: float) -> None:
        """Drop numbers of at most this norm, and more, to leave `most`."""
        values = [piece.data for piece in self.pieces]
        threshold = threshold_within(frobenius, *values, most=most)
        self.threshold = max(self.threshold, threshold)
        pieces = []
        squares = []
        for piece in self.pieces:
            core, dropped = drop_below(piece, self.threshold)
            pieces.append(core)
            squares.append(dropped)
        self.pieces = pieces
        self.squares += math.fsum(squares)


def _transformed(transform: Transform | None, block: np.ndarray) -> np.ndarray:
    """`transform` of the columns of `block`, filled up with zeros to a multiple of `COLUMNS`."""
    if transform is None:
        return np.ascontiguousarray(block)
    rows, columns = block.shape
    padded_columns = -(-columns // COLUMNS) * COLUMNS
    padded = np.zeros((rows, padded_columns), np.float32)
    padded[:, :columns] = block
    return transform(padded)[:, :columns]
