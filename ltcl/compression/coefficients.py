# SPDX-License-Identifier: BSD-3-Clause
"""The numbers of R between two bases, C = W_out R W_in^T, as R streams by, without the small ones.

Blocks of rows go through W_in, what is below a first threshold is dropped, then blocks of columns go through
W_out, and the rest below the threshold is dropped. Both bases are orthonormal, so that a number dropped is
an error of R of just its size: R~ - R = -(D_1 + W_out^T D_2) up to W_in. Where the first pass drops nothing,
the error is ||D_2||_F to rounding; otherwise at most the sum of both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression.sources import COLUMNS, RowSource, at_once, cut

Transform = Callable[[np.ndarray], np.ndarray]  # (N, k) float32 -> (M, k) float32, k a multiple of COLUMNS


@dataclass(frozen=True)
class Coefficients:
    """C with the small ones dropped.

    Attributes
    ----------
    core : csr_array, float32
    first, second : float
        Frobenius norm of what was dropped between the passes, and at the end.
    threshold : float
        All of `core` is at least this large.
    """

    core: scipy.sparse.csr_array
    first: float
    second: float
    threshold: float

    @property
    def dropped(self) -> float:
        """||R~ - R||_F, or a bound on it where the first pass dropped something."""
        return self.first + self.second

    def above(self, threshold: float) -> Coefficients:
        """Those of at least `threshold`."""
        if threshold <= self.threshold:
            return self
        keep = np.abs(self.core.data) >= threshold
        gone = self.core.data[~keep].astype(np.float64)
        ends = np.concatenate([[0], np.cumsum(keep)])[self.core.indptr]
        core = scipy.sparse.csr_array((self.core.data[keep], self.core.indices[keep], ends), self.core.shape)
        second = math.sqrt(self.second**2 + float(gone @ gone))
        return Coefficients(core, self.first, second, threshold)


def coefficients(
    R: RowSource,
    out: Transform | None,
    into: Transform | None,
    threshold: float,
    *,
    first: float = 0.0,
    memory: int | None = None,
    progress: Callable[[float], object] | None = None,
) -> Coefficients:
    """C = W_out R W_in^T without what is below `threshold`.

    Parameters
    ----------
    R : RowSource, (M, N)
    out, into : callable (N, k) -> (M', k), or None for pixels
        W_out of (M, k), W_in of (N, k); orthonormal.
    threshold, first : float
        What is smaller is dropped at the end, and between the passes. With 0 nothing is dropped between, and
        all M x N' numbers lie in memory there; else those that are left, with 8 bytes each.
    memory : int, optional
        Bytes for a block; as `sources.at_once`. The result has the same bits for any, without `first`.
    progress : callable, optional
        Called with the share that is done.

    Examples
    --------
    >>> import numpy
    >>> from ltcl.compression.sources import source
    >>> turn = numpy.array([[1, 1], [1, -1]]) / numpy.sqrt(2)
    >>> R = source("R", numpy.array([[1.0, 1.0], [1.0, 1.001]]))
    >>> c = coefficients(R, turn.__matmul__, turn.__matmul__, 0.1)
    >>> c.core.nnz, round(c.dropped, 4)  # all but one small
    (1, 0.0009)
    """
    done = progress or (lambda share: None)
    if out is None:
        return _in_one_pass(R, into, threshold, memory, done)
    between = _first_pass(R, into, first, memory, lambda share: done(share / 2))
    rows, columns = R.shape[0], between.columns
    pieces, squares = [], []
    for start, stop in cut(columns, at_once(rows, memory)):
        block = _transformed(out, _dense(between.matrix[:, start:stop]))
        kept, lost = _chosen(block, threshold)
        pieces.append(kept)
        squares += lost
        done(0.5 + 0.5 * stop / columns)
    core = scipy.sparse.csr_array(scipy.sparse.hstack(pieces, format="csc"))
    return Coefficients(core, between.dropped, math.sqrt(math.fsum(squares)), threshold)


@dataclass(frozen=True)
class _Between:
    """R W_in^T: dense, or sparse by columns where something was dropped."""

    matrix: np.ndarray | scipy.sparse.csc_array
    columns: int
    dropped: float


def _in_one_pass(
    R: RowSource, into: Transform | None, threshold: float, memory: int | None, done: Callable
) -> Coefficients:
    pieces, squares = [], []
    for stop, block in _blocks(R, into, memory):  # (N', m): columns are rows of R
        kept, lost = _chosen(block, threshold)
        pieces.append(kept)
        squares += lost
        done(stop / R.shape[0])
    core = scipy.sparse.hstack(pieces, format="csc").T
    return Coefficients(scipy.sparse.csr_array(core), 0.0, math.sqrt(math.fsum(squares)), threshold)


def _first_pass(
    R: RowSource, into: Transform | None, first: float, memory: int | None, done: Callable
) -> _Between:
    pieces, squares = [], []
    dense: np.ndarray | None = None
    for stop, block in _blocks(R, into, memory):
        if first > 0.0:
            kept, lost = _chosen(block, first)
            pieces.append(kept)
            squares += lost
        else:
            dense = _room(R.shape[0], len(block)) if dense is None else dense
            dense[stop - block.shape[1] : stop] = block.T
        done(stop / R.shape[0])
    if dense is not None:
        return _Between(dense, dense.shape[1], 0.0)
    turned = scipy.sparse.csc_array(scipy.sparse.hstack(pieces, format="csc").T)
    return _Between(turned, len(turned.indptr) - 1, math.sqrt(math.fsum(squares)))


def _room(rows: int, columns: int) -> np.ndarray:
    checks.fits_host(f"{rows} x {columns} numbers between two passes", 4 * rows * columns)
    return np.empty((rows, columns), np.float32)


def _blocks(R: RowSource, into: Transform | None, memory: int | None) -> Iterable[tuple[int, np.ndarray]]:
    """(stop, W_in times rows .. stop of R as columns, (N', m) float32)."""
    for start, stop in cut(R.shape[0], at_once(R.shape[1], memory)):
        rows = np.asarray(R.rows(start, stop), np.float32)
        yield stop, _transformed(into, rows.T)


def _transformed(transform: Transform | None, block: np.ndarray) -> np.ndarray:
    """`transform` of the columns of `block`, filled up with zeros to a multiple of `COLUMNS`."""
    if transform is None:
        return np.ascontiguousarray(block)
    count = block.shape[1]
    padded = np.zeros((len(block), -(-count // COLUMNS) * COLUMNS), np.float32)
    padded[:, :count] = block
    return transform(padded)[:, :count]


def _dense(part: np.ndarray | scipy.sparse.csc_array) -> np.ndarray:
    return part if isinstance(part, np.ndarray) else part.toarray()


def _chosen(block: np.ndarray, threshold: float) -> tuple[scipy.sparse.csc_array, list[float]]:
    """What is at least `threshold` as sparse columns, and the sum of squares of the rest in each column."""
    keep = np.abs(block) >= threshold
    keep &= block != 0.0
    turned = np.ascontiguousarray(keep.T)
    rows = np.nonzero(turned)[1]
    ends = np.concatenate([[0], np.cumsum(np.count_nonzero(turned, axis=1))])
    kept = scipy.sparse.csc_array((block.T[turned], rows.astype(np.int32), ends), block.shape)
    # Summed row by row: a column has the same sum in any block.
    rest = np.where(keep, np.float32(0.0), block).astype(np.float64)
    return kept, np.sum(np.square(rest, out=rest), axis=0).tolist()
