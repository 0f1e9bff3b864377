# SPDX-License-Identifier: BSD-3-Clause
"""C = W_out R W_in^T without its small numbers.

Where the host has room for all of C, one threshold is taken of it. Else blocks of rows stream through W_in,
what is below a first threshold is dropped, and blocks of columns stream through W_out. Both bases are
orthonormal: the error of R in the Frobenius norm is at most the sum of what both passes drop.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression.sources import COLUMNS, Rows, cut, rows_at_once

Transform = Callable[[np.ndarray], np.ndarray]  # (N, k) float32 -> (N, k) float32, k a multiple of COLUMNS
Progress = Callable[[float], object]
_CACHED = 512  # rows of a dense block that stay in the cache while they are looked at several times
_SHIFT = 16  # bits of a float32 that a bin of `threshold_within` leaves open
_PIECE = 1 << 22  # numbers counted at once


def drop_below(X: Any, threshold: float) -> tuple[scipy.sparse.csr_array, float]:
    """The numbers of X, dense or CSR, of at least `threshold`, and the sum of squares of the others."""
    if scipy.sparse.issparse(X):
        keep = np.abs(X.data) >= threshold
        small = X.data[~keep].astype(np.float64)
        ends = np.concatenate([[0], np.cumsum(keep)]).astype(X.indptr.dtype)[X.indptr]
        return scipy.sparse.csr_array((X.data[keep], X.indices[keep], ends), X.shape), float(small @ small)
    counts, indices, values, squares = [np.zeros(1, np.int64)], [], [], []
    for start, stop in cut(len(X), _CACHED):
        block = np.ascontiguousarray(X[start:stop])
        keep = (np.abs(block) >= threshold) & (block != 0.0)
        places = np.flatnonzero(keep)
        counts.append(np.count_nonzero(keep, axis=1))
        indices.append((places % block.shape[1]).astype(np.int32))
        values.append(block.flat[places])
        rest = block.astype(np.float64)
        rest.flat[places] = 0.0
        squares.append(float(np.vdot(rest, rest)))
    arrays = (np.concatenate(values), np.concatenate(indices), np.cumsum(np.concatenate(counts)))
    return scipy.sparse.csr_array(arrays, X.shape), math.fsum(squares)


def threshold_within(frobenius: float, *arrays: np.ndarray, most: float = math.inf) -> float:
    """The largest threshold below which float32 arrays have at most this norm; more, to leave `most` numbers.

    Without sorting: numbers are counted in bins of less than a percent, the same exponent and first seven
    bits behind it, and the threshold is an edge of a bin.
    """
    bins = 1 << (32 - _SHIFT - 1)
    counts, squares = np.zeros(bins, np.int64), np.zeros(bins)
    for flat in map(np.ravel, arrays):
        for start, stop in cut(flat.size, _PIECE):
            piece = np.abs(flat[start:stop])
            keys = piece.view(np.int32) >> _SHIFT
            counts += np.bincount(keys, minlength=bins)
            squares += np.bincount(keys, np.square(piece, dtype=np.float64), minlength=bins)
    edge = int(np.searchsorted(np.cumsum(squares), frobenius**2 * (1 + 1e-12), side="right"))
    edge = min(edge, int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0)
    above = np.cumsum(counts[::-1])[::-1]  # numbers in this bin and beyond
    edge = max(edge, int(np.searchsorted(-above, -most, side="left")))
    return float(np.int32(edge << _SHIFT).view(np.float32))


@dataclass(frozen=True)
class Coefficients:
    """The numbers of R between two bases of at least `threshold`: R~ = W_out^T core W_in.

    `first` is the Frobenius norm of what was dropped between the passes, `second` of what was at the end.
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
        threshold = threshold_within(math.sqrt(max(drop**2 - self.dropped**2, 0.0)), self.core.data)
        if threshold <= self.threshold:
            return self
        core, lost = drop_below(self.core, threshold)
        second = math.sqrt(self.second**2 + lost)
        return dataclasses.replace(self, core=core, second=second, threshold=threshold)


def coefficients(
    R: Rows,
    out: Transform | None,
    into: Transform | None,
    threshold: float | None = None,
    *,
    drop: float = 0.0,
    most: float = math.inf,
    first: float | None = None,
    progress: Progress = lambda share: None,
) -> Coefficients:
    """C = W_out R W_in^T without what is below `threshold`, and below `first` between the two passes.

    W_out of (M, k) and W_in of (N, k) numbers are orthonormal, None of pixels. By default, `threshold` is the
    largest that drops no more than the Frobenius norm `drop`, or a larger one where that keeps more than
    `most` numbers, and `first` 0 where the host has room for all numbers twice, else what drops about a third
    of `drop`, or more. The core has the same bits for any `R.memory`.
    """
    (m, n), room = R.shape, checks.host_memory() // 2
    if first is None and 4 * m * n <= room:
        C = np.empty((m, n), np.float32)
        for at, rows in R.blocks():
            C[at] = rows
            progress(0.5 * at.stop / m)
        for W, side in ((into, C.T), (out, C)):
            if W is not None:
                for start, stop in cut(side.shape[1], _CACHED):
                    side[:, start:stop] = _transformed(W, side[:, start:stop])
        threshold = threshold_within(drop, C, most=most) if threshold is None else threshold
        core, lost = drop_below(C, threshold)
        progress(1.0)
        return Coefficients(core, 0.0, math.sqrt(lost), threshold)

    def from_rows() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """C^T = W_in R^T, a column for each row of R."""
        for at, rows in R.blocks():
            yield np.arange(at.start, at.stop), _transformed(into, rows.T)
            progress(0.5 * at.stop / m)

    most = min(most, room // 16)  # 8 bytes each, and up to twice as many for a while
    if out is None:
        core, lost, threshold = _collect(from_rows(), (n, m), threshold, drop, most)
        return Coefficients(scipy.sparse.csr_array(core.T), 0.0, lost, threshold)
    between, left, _ = _collect(from_rows(), (n, m), first, drop / 3.0, room // 16)
    between: Any = between.T  # sparse by columns, of which few are left where light is smooth
    columns = np.flatnonzero(np.diff(between.indptr))

    def from_columns() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for start, stop in cut(len(columns), rows_at_once(m, R.memory)):
            yield columns[start:stop], _transformed(out, between[:, columns[start:stop]].toarray())
            progress(0.5 + 0.5 * stop / len(columns))

    core, lost, threshold = _collect(from_columns(), (m, n), threshold, drop, most)
    return Coefficients(core, left, lost, threshold)


def _collect(
    blocks: Iterable[tuple[np.ndarray, np.ndarray]],
    shape: tuple[int, int],
    threshold: float | None,
    drop: float,
    most: float,
) -> tuple[scipy.sparse.csr_array, float, float]:
    """A matrix by blocks of its columns, without what is below a threshold; what was lost; and the threshold.

    One that is not given rises whenever twice as many numbers as `most` have come together, never above what
    all of them call for.
    """
    pieces: list[Any] = [scipy.sparse.csr_array((shape[0], 0), dtype=np.float32)]
    columns, lost, lowest = [np.zeros(0, np.int64)], 0.0, threshold or 0.0

    def raise_threshold(frobenius: float) -> None:
        nonlocal pieces, lost, lowest
        lowest = max(lowest, threshold_within(frobenius, *(piece.data for piece in pieces), most=most))
        cores, squares = zip(*(drop_below(piece, lowest) for piece in pieces), strict=True)
        pieces, lost = list(cores), lost + math.fsum(squares)

    for which, block in blocks:
        core, squares = drop_below(block, lowest)
        pieces.append(core)
        columns.append(which)
        lost += squares
        if threshold is None and sum(piece.nnz for piece in pieces) > 2 * most:
            raise_threshold(0.0)
    if threshold is None:
        raise_threshold(math.sqrt(max(drop**2 - lost, 0.0)))
    whole: Any = scipy.sparse.hstack(pieces, format="csr")
    indices = np.concatenate(columns).astype(whole.indices.dtype)[whole.indices]
    return scipy.sparse.csr_array((whole.data, indices, whole.indptr), shape), math.sqrt(lost), lowest


def _transformed(transform: Transform | None, block: np.ndarray) -> np.ndarray:
    """`transform` of the columns of `block`, filled up with zeros to a multiple of `COLUMNS`."""
    if transform is None:
        return np.ascontiguousarray(block)
    count = block.shape[1]
    padded = np.zeros((len(block), -(-count // COLUMNS) * COLUMNS), np.float32)
    padded[:, :count] = block
    return transform(padded)[:, :count]
