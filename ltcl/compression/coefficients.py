# SPDX-License-Identifier: BSD-3-Clause
"""The numbers of R between two bases, C = W_out R W_in^T, as R streams by, without the small ones.

Blocks of rows go through W_in, what is below a first threshold is dropped, then blocks of columns go through
W_out, and the rest below the threshold is dropped. Both bases are orthonormal, so that a number dropped is
an error of R of just its size: R~ - R = -(D_1 + W_out^T D_2) up to W_in. Where the first pass drops nothing,
the error is ||D_2||_F to rounding; otherwise at most the sum of both.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression.magnitudes import Magnitudes
from ltcl.compression.sieve import sieve
from ltcl.compression.sources import COLUMNS, RowSource, at_once, cut

Transform = Callable[[np.ndarray], np.ndarray]  # (N, k) float32 -> (M, k) float32, k a multiple of COLUMNS
_FEW = 16  # blocks tell what may be dropped between the passes
_SHARE = 8  # one of so many rows or columns is looked at for a threshold
_LEAST = 512  # but so many at least, or all


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
        return dataclasses.replace(self, core=core, second=second, threshold=threshold)


def coefficients(
    R: RowSource,
    out: Transform | None,
    into: Transform | None,
    threshold: float | None = None,
    *,
    drop: float = 0.0,
    most: int | None = None,
    first: float | None = None,
    memory: int | None = None,
    progress: Callable[[float], object] | None = None,
) -> Coefficients:
    """C = W_out R W_in^T without what is below `threshold`.

    Parameters
    ----------
    R : RowSource, (M, N)
    out, into : callable (N, k) -> (M', k), or None for pixels
        W_out of (M, k), W_in of (N, k); orthonormal.
    threshold : float, optional
        What is smaller is dropped at the end. When not given, a sample of the numbers is looked at for one
        that drops about the Frobenius norm `drop`, or more where about `most` are kept with it.
    first : float, optional
        What is smaller is dropped between the passes. With 0 nothing is, and all M x N' numbers lie in
        memory there; else those that are left, with 8 bytes each. When not given, 0 where the host has room
        for all, twice; else what drops about a third of `drop`, or more where even that has no room.
    memory : int, optional
        Bytes for a block; as `sources.at_once`. The result has the same bits for any, with a threshold and
        without `first`.
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
        last: _Rows | _Columns = _Rows(R, into)
    else:
        first = _first(_Rows(R, into), drop) if first is None else first
        last = _Columns(_first_pass(R, into, first, memory, lambda share: done(share / 2)), out)
    if threshold is None:
        threshold = last.sample().threshold_for(drop, math.inf if most is None else most)
    pieces, squares, busy = [], [], last.busy
    for start, stop in cut(len(busy), at_once(last.height, memory)):
        kept, lost = sieve(last.block(busy[start:stop]), threshold)
        pieces.append(kept)
        squares += lost
        done(stop / len(busy) if out is None else 0.5 + 0.5 * stop / len(busy))
    done(1.0)
    core = _spread(pieces, busy, (last.height, last.count))
    core = scipy.sparse.csr_array(core if out is not None else core.T)
    return Coefficients(core, last.dropped, math.sqrt(math.fsum(squares)), threshold)


def _spread(
    pieces: list[scipy.sparse.csc_array], busy: np.ndarray, shape: tuple[int, int]
) -> scipy.sparse.csc_array:
    """Columns `busy` of a matrix, the others of which are empty."""
    if not pieces:
        return scipy.sparse.csc_array(shape, dtype=np.float32)
    found = scipy.sparse.csc_array(scipy.sparse.hstack(pieces, format="csc"))
    rows, _ = found.shape or shape
    lengths = np.zeros(shape[1], np.int64)
    lengths[busy] = np.diff(found.indptr)
    ends = np.concatenate([[0], np.cumsum(lengths)])
    return scipy.sparse.csc_array((found.data, found.indices, ends), (rows, shape[1]))


@dataclass(frozen=True)
class _Sample:
    """Magnitudes of a `share` of all numbers."""

    magnitudes: Magnitudes
    share: float

    def threshold_for(self, drop: float, most: float) -> float:
        threshold = self.magnitudes.threshold(drop * math.sqrt(self.share))
        if math.isinf(most):
            return threshold
        return max(threshold, self.magnitudes.at_most(int(most * self.share)))


@dataclass(frozen=True)
class _Rows:
    """C^T = W_in R^T, a column for each row of R."""

    R: RowSource
    into: Transform | None
    dropped = 0.0

    @property
    def count(self) -> int:
        return self.R.shape[0]

    @property
    def busy(self) -> np.ndarray:
        return np.arange(self.count)

    @property
    def height(self) -> int:
        return self.R.shape[1]

    def block(self, which: np.ndarray) -> np.ndarray:
        rows = np.asarray(self.R.rows(int(which[0]), int(which[-1]) + 1), np.float32)
        return _transformed(self.into, rows.T)

    def sample(self, most: int = 1 << 30) -> _Sample:
        """Of an eighth of the rows or more, and at most `most` blocks."""
        starts = np.arange(0, self.count, COLUMNS)
        wanted = min(max(-(-len(starts) // _SHARE), _LEAST // COLUMNS), len(starts), most)
        chosen = np.sort(np.random.default_rng(0).choice(starts, wanted, replace=False))
        blocks = [np.arange(start, min(start + COLUMNS, self.count)) for start in chosen]
        return _sampled(self, blocks)


@dataclass(frozen=True)
class _Columns:
    """C = W_out (R W_in^T), a column for each of R W_in^T."""

    between: _Between
    out: Transform

    @property
    def count(self) -> int:
        return self.between.columns

    @cached_property
    def busy(self) -> np.ndarray:
        """Columns with anything in them: of smooth light few are left by then."""
        between = self.between.matrix
        if isinstance(between, np.ndarray):
            return np.arange(self.count)
        return np.flatnonzero(np.diff(between.indptr))

    @property
    def height(self) -> int:
        return self.between.rows

    @property
    def dropped(self) -> float:
        return self.between.dropped

    def block(self, which: np.ndarray) -> np.ndarray:
        part = self.between.matrix[:, which]
        return _transformed(self.out, part if isinstance(part, np.ndarray) else part.toarray())

    def sample(self) -> _Sample:
        # Single columns: those of large numbers lie side by side, and blocks would hit or miss them all.
        chosen = np.random.default_rng(0).permutation(self.busy)
        chosen = chosen[: max(-(-len(chosen) // _SHARE), _LEAST)]
        return _sampled(self, [chosen[start:stop] for start, stop in cut(len(chosen), 4 * COLUMNS)])


def _sampled(last: _Rows | _Columns, blocks: list[np.ndarray]) -> _Sample:
    found = [Magnitudes.of(last.block(which)) for which in blocks]
    if not found:
        return _Sample(Magnitudes.of(np.zeros(0, np.float32)), 1.0)
    counts, squares = sum(m.counts for m in found), sum(m.squares for m in found)
    share = sum(map(len, blocks)) / len(last.busy)
    return _Sample(Magnitudes(np.asarray(counts), np.asarray(squares)), share)


def _first(rows: _Rows, drop: float) -> float:
    """A threshold between the passes that leaves what the host has room for."""
    room = checks.host_memory() // 2
    if 4 * rows.count * rows.height <= room:
        return 0.0
    return rows.sample(_FEW).threshold_for(drop / 3, room // 16)  # 8 bytes each, turned once


@dataclass(frozen=True)
class _Between:
    """R W_in^T: dense, or sparse by columns where something was dropped."""

    matrix: np.ndarray | scipy.sparse.csc_array
    rows: int
    columns: int
    dropped: float


def _first_pass(
    R: RowSource, into: Transform | None, first: float, memory: int | None, done: Callable
) -> _Between:
    pieces, squares = [], []
    dense: np.ndarray | None = None
    for stop, block in _blocks(R, into, memory):
        if first > 0.0:
            kept, lost = sieve(block, first)
            pieces.append(kept)
            squares += lost
        else:
            dense = _room(R.shape[0], len(block)) if dense is None else dense
            dense[stop - block.shape[1] : stop] = block.T
        done(stop / R.shape[0])
    if dense is not None:
        return _Between(dense, len(dense), dense.shape[1], 0.0)
    turned = scipy.sparse.csc_array(scipy.sparse.hstack(pieces, format="csc").T)
    return _Between(turned, R.shape[0], len(turned.indptr) - 1, math.sqrt(math.fsum(squares)))


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
