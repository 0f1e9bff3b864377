# SPDX-License-Identifier: BSD-3-Clause
"""C = W_out R W_in^T without its small numbers, and R = P + W^T C W of what is partly sharp.

Where the host has room for all of C, it is transformed in place and one threshold is taken of it. Else blocks
of rows stream through W_in, what is below a first threshold is dropped, and blocks of columns stream through
W_out. Both bases are orthonormal, so that a number dropped is an error of R of just its size: R~ - R =
-(D_1 + W_out^T D_2) up to W_in. Where the first pass drops nothing, the error is ||D_2||_F to rounding;
otherwise at most the sum of both.
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
from ltcl.compression.sources import COLUMNS, RowSource, cut, rows_at_once
from ltcl.operators import Basis

Transform = Callable[[np.ndarray], np.ndarray]  # (N, k) float32 -> (N, k) float32, k a multiple of COLUMNS
Progress = Callable[[float], object]
_CACHED = 512  # rows of a dense block that stay in the cache while they are looked at several times
_SHIFT = 16  # bits of a float32 that a bin of `Magnitudes` leaves open
_PIECE = 1 << 22  # numbers counted at once
_START, _FALL = 0.5, 0.7  # a sum: the first threshold, of the largest number; of each the next one
_LEAST = 1e-7  # of the largest number: float32 has nothing to tell below
_COPIES = 5  # of R at once: R, P, what is worked on, and what NumPy needs for it


def drop_below(X: Any, threshold: float) -> tuple[scipy.sparse.csr_array, float]:
    """The numbers of X, dense or CSR, of at least `threshold`, and the sum of squares of the others.

    >>> kept, lost = drop_below(np.array([[3.0, 0.5], [0.0, -2.0]]), 1.0)
    >>> kept.toarray().tolist(), lost
    ([[3.0, 0.0], [0.0, -2.0]], 0.25)
    """
    if scipy.sparse.issparse(X):
        keep = np.abs(X.data) >= threshold
        lost = X.data[~keep].astype(np.float64)
        ends = np.concatenate([[0], np.cumsum(keep)]).astype(X.indptr.dtype)[X.indptr]
        return scipy.sparse.csr_array((X.data[keep], X.indices[keep], ends), X.shape), float(lost @ lost)
    counts, indices, values, squares = [np.zeros(1, np.int64)], [], [], []
    for start, stop in cut(len(X), _CACHED):
        part = np.ascontiguousarray(X[start:stop])
        keep = np.abs(part) >= threshold
        keep &= part != 0.0
        places = np.flatnonzero(keep)
        counts.append(np.count_nonzero(keep, axis=1))
        indices.append((places % part.shape[1]).astype(np.int32))
        values.append(part.flat[places])
        rest = part.astype(np.float64)
        rest.flat[places] = 0.0
        squares.append(float(np.vdot(rest, rest)))
    arrays = (np.concatenate(values), np.concatenate(indices), np.cumsum(np.concatenate(counts)))
    return scipy.sparse.csr_array(arrays, X.shape), math.fsum(squares)


@dataclass(frozen=True)
class Magnitudes:
    """How many numbers of a matrix are how large, in bins of less than a percent, found without sorting.

    A bin is all float32 numbers with the same exponent and first seven bits behind it.
    """

    counts: np.ndarray
    squares: np.ndarray

    @classmethod
    def of(cls, *arrays: np.ndarray) -> Magnitudes:
        """Those of float32 arrays, all together.

        >>> m = Magnitudes.of(np.array([3.0, -4.0, 12.0], np.float32))
        >>> m.threshold(5.0), m.kept(m.threshold(5.0)), m.threshold(4.9)
        (12.0, 1, 4.0)
        """
        bins = 1 << (32 - _SHIFT - 1)
        counts, squares = np.zeros(bins, np.int64), np.zeros(bins)
        for flat in map(np.ravel, arrays):
            for start, stop in cut(flat.size, _PIECE):
                piece = np.abs(flat[start:stop])
                keys = piece.view(np.int32) >> _SHIFT
                counts += np.bincount(keys, minlength=bins)
                squares += np.bincount(keys, np.square(piece, dtype=np.float64), minlength=bins)
        return cls(counts, squares)

    def threshold(self, frobenius: float, most: float = math.inf) -> float:
        """The largest below which all have at most this Frobenius norm, or more to keep at most `most`."""
        allowed = frobenius**2 * (1 + 1e-12)
        bins = int(np.searchsorted(np.cumsum(self.squares), allowed, side="right"))
        bins = min(bins, int(np.flatnonzero(self.counts)[-1]) + 1 if self.counts.any() else 0)
        above = np.cumsum(self.counts[::-1])[::-1]  # numbers in this bin and beyond
        bins = max(bins, int(np.searchsorted(-above, -most, side="left")))
        return float(np.int32(bins << _SHIFT).view(np.float32))

    def kept(self, threshold: float) -> int:
        """How many are at least `threshold`, an edge of a bin."""
        return int(self.counts[int(np.float32(threshold).view(np.int32)) >> _SHIFT :].sum())


@dataclass(frozen=True)
class Coefficients:
    """The large numbers of R between two bases: R~ = W_out^T core W_in.

    Of a sum, R~ = P + W_out^T C W_in, `core` is [P C], (N, 2 N). All numbers of it are at least `threshold`.
    `first` is the Frobenius norm of what was dropped between the passes, or left by a decomposition, `second`
    of what was at the end.
    """

    core: scipy.sparse.csr_array
    first: float
    second: float
    threshold: float
    is_sum: bool = False

    @property
    def dropped(self) -> float:
        """||R~ - R||_F, or a bound on it: what several passes, or both parts of a sum, drop may add up."""
        return self.first + (math.sqrt(2.0) if self.is_sum else 1.0) * self.second

    def above(self, threshold: float) -> Coefficients:
        """Those of at least `threshold`."""
        if threshold <= self.threshold:
            return self
        core, lost = drop_below(self.core, threshold)
        second = math.sqrt(self.second**2 + lost)
        return dataclasses.replace(self, core=core, second=second, threshold=threshold)

    def parts(self) -> list[scipy.sparse.csr_array]:
        """[P, C] of a sum, else [C], (N, N) each."""
        n = len(self.core.indptr) - 1
        halves = (self.core[:, :n], self.core[:, n:]) if self.is_sum else (self.core,)
        return [scipy.sparse.csr_array(half) for half in halves]


def coefficients(
    R: RowSource,
    out: Transform | None,
    into: Transform | None,
    threshold: float | None = None,
    *,
    drop: float = 0.0,
    most: float | None = None,
    first: float | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Coefficients:
    """C = W_out R W_in^T without what is below `threshold`.

    W_out of (M, k) and W_in of (N, k) numbers are orthonormal, None of pixels. The `threshold` not given, it
    is the largest that drops no more than the Frobenius norm `drop`, or a larger one where that keeps more
    than `most` numbers. What is below `first` is dropped between the passes over rows and columns; not given,
    nothing where the host has room for all numbers twice, else what drops about a third of `drop`, or more.
    Blocks take `memory` bytes; the core has the same bits for any. `progress` hears the share that is done.

    >>> from ltcl.compression.sources import source
    >>> turn = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
    >>> R = source("R", np.array([[1.0, 1.0], [1.0, 1.001]]))
    >>> c = coefficients(R, turn.__matmul__, turn.__matmul__, 0.1)
    >>> c.core.nnz, round(c.dropped, 4)  # all but one small
    (1, 0.0009)
    """
    (m, n), done, room = R.shape, progress or (lambda share: None), checks.host_memory() // 2
    most = math.inf if most is None else most
    if first is None and 4 * m * n <= room:
        C = _read(R, memory, lambda share: done(0.5 * share))
        _transform_sides(C, out, into)
        if threshold is None:
            threshold = Magnitudes.of(C).threshold(drop, most)
        core, lost = drop_below(C, threshold)
        done(1.0)
        return Coefficients(core, 0.0, math.sqrt(lost), threshold)

    def from_rows() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """C^T = W_in R^T, a column for each row of R."""
        for start, stop in cut(m, rows_at_once(n, memory)):
            rows = np.asarray(R.rows(start, stop), np.float32)
            yield np.arange(start, stop), _transformed(into, rows.T)
            done(0.5 * stop / m)

    most = min(most, room // 16)  # 8 bytes each, and up to twice as many for a while
    if out is None:
        core, lost, threshold = _collect(from_rows(), (n, m), threshold, drop, most)
        return Coefficients(scipy.sparse.csr_array(core.T), 0.0, lost, threshold)
    rows, left, _ = _collect(from_rows(), (n, m), first, drop / 3.0, room // 16)
    between: Any = rows.T  # sparse by columns, of which few are left where light is smooth
    columns = np.flatnonzero(np.diff(between.indptr))

    def from_columns() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for start, stop in cut(len(columns), rows_at_once(m, memory)):
            yield columns[start:stop], _transformed(out, between[:, columns[start:stop]].toarray())
            done(0.5 + 0.5 * stop / len(columns))

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

    One that is not given rises whenever twice as many numbers as `most` have come together. That is never
    above what all of them call for, so that the end has no trace of how they came.
    """
    pieces: list[Any] = [scipy.sparse.csr_array((shape[0], 0), dtype=np.float32)]
    columns, lost, lowest = [np.zeros(0, np.int64)], 0.0, threshold or 0.0

    def raise_threshold(frobenius: float) -> None:
        nonlocal pieces, lost, lowest
        lowest = max(lowest, Magnitudes.of(*(piece.data for piece in pieces)).threshold(frobenius, most))
        found = [drop_below(piece, lowest) for piece in pieces]
        pieces, lost = [piece for piece, _ in found], lost + math.fsum(squares for _, squares in found)

    for which, block in blocks:
        kept, squares = drop_below(block, lowest)
        pieces.append(kept)
        columns.append(which)
        lost += squares
        if threshold is None and sum(piece.nnz for piece in pieces) > 2 * most:
            raise_threshold(0.0)
    if threshold is None:
        raise_threshold(math.sqrt(max(drop**2 - lost, 0.0)))
    whole: Any = scipy.sparse.hstack(pieces, format="csr")
    indices = np.concatenate(columns).astype(whole.indices.dtype)[whole.indices]
    return scipy.sparse.csr_array((whole.data, indices, whole.indptr), shape), math.sqrt(lost), lowest


def require_room(pixels: int) -> None:
    """Refuse, by a MemoryLimitError, to decompose R of so many pixels where the host has no room for it."""
    checks.fits_host(f"R of {pixels} pixels in two parts", 4 * _COPIES * pixels**2)


def sparse_plus_wavelet(
    R: RowSource, W: Basis, drop: float, memory: int | None = None, progress: Progress | None = None
) -> Coefficients:
    """P and C of R = P + W^T C W, down to the first threshold that leaves at most the Frobenius norm `drop`.

    Morphological component analysis (Starck, Elad and Donoho 2005): both parts in turn take what is large in
    what the other leaves,

        C = hard(W (R - P) W^T, t),    P = hard(R - W^T C W, t),

    while t falls. It must fall slowly: a part that takes small numbers early takes those of the other for its
    own. Where float32 does not reach `drop`, `first` of the result is above. R is held on the host, a few
    times, or refused.

    >>> import ltcl
    >>> from ltcl.compression.sources import source
    >>> from ltcl.operators import Wavelet
    >>> W = Wavelet(ltcl.open_device(), (4, 4), "haar")
    >>> R = np.full((16, 16), 1 / 16)  # one coefficient
    >>> R[3, 5] = 2.0  # and one pixel
    >>> [part.nnz for part in sparse_plus_wavelet(source("R", R), W, 1e-3).parts()]
    [1, 1]
    """
    require_room(R.shape[0])
    done, forth, back = progress or (lambda share: None), on_host(W), on_host(W, transpose=True)
    A = _read(R, memory, done=lambda share: None)
    P, C = np.zeros_like(A), scipy.sparse.csr_array(A.shape, dtype=np.float32)
    largest, whole = float(np.abs(A).max(initial=0.0)), _frobenius(A)
    left, t = whole, _START * largest
    while left > drop and t > _LEAST * largest:
        work = A - P
        _transform_sides(work, forth, forth)
        work[np.abs(work) < t] = 0.0
        C = scipy.sparse.csr_array(work)
        _transform_sides(work, back, back)
        np.subtract(A, work, out=work)
        P = np.where(np.abs(work) >= t, work, np.float32(0.0))
        left, t = _frobenius(work - P), t * _FALL
        way = math.log(whole / drop) if drop > 0.0 else math.inf  # in powers
        done(math.log(whole / left) / way if left > drop else 1.0)
    core = scipy.sparse.csr_array(scipy.sparse.hstack([scipy.sparse.csr_array(P), C], format="csr"))
    return Coefficients(core, left, 0.0, min(t / _FALL, largest), is_sum=True)


def on_host(W: Basis | None, transpose: bool = False) -> Transform | None:
    """W, or W^T, of arrays on the host."""
    if W is None:
        return None
    apply = W.apply_transpose if transpose else W.apply
    return lambda x: apply(W.device.upload(x)).get()


def _read(R: RowSource, memory: int | None, done: Progress) -> np.ndarray:
    """All of it, (M, N) float32."""
    A = np.empty(R.shape, np.float32)
    for start, stop in cut(len(A), rows_at_once(A.shape[1], memory)):
        A[start:stop] = R.rows(start, stop)
        done(stop / len(A))
    return A


def _transform_sides(X: np.ndarray, out: Transform | None, into: Transform | None) -> None:
    """X (M, N), overwritten with W_out X W_in^T."""
    for W, side in ((into, X.T), (out, X)):
        if W is not None:
            for start, stop in cut(side.shape[1], _CACHED):
                side[:, start:stop] = _transformed(W, side[:, start:stop])


def _transformed(transform: Transform | None, block: np.ndarray) -> np.ndarray:
    """`transform` of the columns of `block`, filled up with zeros to a multiple of `COLUMNS`."""
    if transform is None:
        return np.ascontiguousarray(block)
    count = block.shape[1]
    padded = np.zeros((len(block), -(-count // COLUMNS) * COLUMNS), np.float32)
    padded[:, :count] = block
    return transform(padded)[:, :count]


def _frobenius(X: np.ndarray) -> float:
    return math.sqrt(float(np.einsum("ij,ij->", X, X, dtype=np.float64)))
