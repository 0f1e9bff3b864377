# SPDX-License-Identifier: BSD-3-Clause
"""The blocks of rows of a sweep, and what solves P_AA delta_A = s_A - S_AO delta_O in each.

See `kernels/relax.cl`. A is a block, and O the block before it where that is corrected while the product for
A runs. Of a sparse triangle the entries left of the diagonal are copied out, since a work-item that walks
through them finds them close together then. Elsewhere P_AA is inverted in float64, and the correction is a
small dense product.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators import slabs
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense

INVERTED = 128  # rows of a block whose inverse is kept: few launches, and small beside the matrix
_SAMPLE = 2048  # rows looked at to choose a block
_PIECE = 1 << 22  # entries handled at once on the host
_SIZES = tuple(1 << power for power in range(5, 14))
_LAUNCHES = 20e-6  # seconds of the two launches of a block in sequence: workers wake, and wait for the last
_ENTRY = 1e-9  # seconds of one entry in sequence


@dataclass(frozen=True)
class Rows:
    """S = shift I + scale M, where M has rows to read."""

    M: CSR | Dense
    shift: float
    scale: float

    def diagonal(self) -> np.ndarray:
        """The main diagonal of S, (N,) float64."""
        return self.shift + self.scale * self.M.diagonal()


@dataclass(frozen=True)
class Block:
    """Rows start .. stop; those from `before` on are corrected while the product for the block runs."""

    before: int
    start: int
    stop: int


@dataclass(frozen=True)
class Finish:
    """What finishes a block: its rows, how many of them in sequence or -1, and arguments of the kernels."""

    block: Block
    chained: int
    arguments: tuple[Array, ...]


def cut(n: int, size: int, *, overlap: bool) -> list[Block]:
    """n rows in blocks of `size`; with `overlap` each runs its product while the one before is corrected.

    >>> cut(5, 2, overlap=True)
    [Block(before=0, start=0, stop=2), Block(before=0, start=2, stop=4), Block(before=2, start=4, stop=5)]
    """
    lag = size if overlap else 0
    return [Block(max(start - lag, 0), start, min(start + size, n)) for start in range(0, n, size)]


def best_size(M: CSR | Dense, *, sequential: bool) -> int:
    """Rows of a block of Gauss-Seidel, so that launches and what finishes blocks take least time.

    Each block has buffers of its own, which a device of small ones limits further.
    """
    most = max(1, math.isqrt(slabs.largest(M.device) // 8))
    if not sequential or isinstance(M, Dense):
        return min(INVERTED, most)

    def seconds(size: int) -> float:
        return _LAUNCHES * M.shape[0] / size + _ENTRY * _inside(M, size)

    return min((size for size in _SIZES if size <= most), key=seconds, default=most)


def middle(M: CSR, blocks: list[Block]) -> np.ndarray:
    """How many entries of each row are in columns of the new iterate while its product runs, (N,)."""
    pointers, counts = M.pattern.indptr, np.zeros(M.shape[0], np.int64)
    edges = np.repeat([block.before for block in blocks], [block.stop - block.start for block in blocks])
    for start, stop in _pieces(pointers):
        row = np.repeat(np.arange(start, stop), np.diff(pointers[start : stop + 1]))
        left = M.pattern.indices[pointers[start] : pointers[stop]] < edges[row]
        counts[start:stop] = np.bincount(row[left] - start, minlength=stop - start)
    return counts


def in_sequence(rows: Rows, blocks: list[Block]) -> Iterator[Finish]:
    """The triangles of a sparse matrix: rows that others in the block must precede, and the rest."""
    M, diagonal = rows.M, rows.diagonal()
    assert isinstance(M, CSR)  # noqa: S101 - dense ones are inverted
    for block in blocks:
        count, pointers = block.stop - block.start, M.pattern.indptr[block.start : block.stop + 1]
        row = np.repeat(np.arange(block.start, block.stop), np.diff(pointers))
        columns = M.pattern.indices[pointers[0] : pointers[-1]]
        kept = (columns >= block.start) & (columns < row)
        columns, values = columns[kept], rows.scale * M.data[pointers[0] : pointers[-1]][kept]
        found = np.bincount(row[kept] - block.start, minlength=count)
        order = block.start + np.argsort(found == 0, stable=True)
        starts = count + np.concatenate([[0], np.cumsum(found[found > 0])])
        places = np.concatenate([order, columns])
        weights = np.concatenate([1.0 / diagonal[order], values / diagonal[columns]])
        upload = M.device.upload
        arguments = (upload(starts, np.int32), upload(places, np.int32), upload(weights))
        yield Finish(block, len(starts) - 1, arguments)


def by_inverse(rows: Rows, blocks: list[Block], omega: float | None, method: str) -> Iterator[Finish]:
    """[-P^-1 S_AO, P^-1] of each block: P its triangle with D / omega, or all of S_AA where omega is None.

    Raises
    ------
    InputError
        A block that has no inverse, in the words of `method`.
    MemoryLimitError
        More than the device holds; said before anything is computed.
    """
    M = rows.M
    size = sum((block.stop - block.start) * (block.stop - block.before) for block in blocks)
    M.device.require(4 * size, f"method={method!r} with inverses of {len(blocks)} blocks")
    places = ((slice(block.start, block.stop), slice(block.before, block.stop)) for block in blocks)
    for number, (block, part) in enumerate(zip(blocks, M.parts(places), strict=True)):
        part = rows.scale * part
        known = block.start - block.before
        own = part[:, known:]
        own[np.diag_indices_from(own)] += rows.shift
        inverse = _inverse(own, omega)
        if inverse is None:
            raise InputError(
                f"method={method!r} inverts blocks of S, and block {number}, rows {block.start} to "
                f"{block.stop - 1}, is singular; choose another block= or use method='direct'"
            )
        with np.errstate(over="ignore", invalid="ignore"):  # a sweep with Inf ends as divergence, and says so
            weights = np.hstack([-inverse @ part[:, :known], inverse]).astype(np.float32)
        yield Finish(block, -1, (M.device.upload(weights),))


def _inverse(own: np.ndarray, omega: float | None) -> np.ndarray | None:
    """P^-1, or None where there is none in float64."""
    if omega is not None:
        triangle = np.tril(own, -1) + np.diag(own.diagonal() / omega)
        return scipy.linalg.solve_triangular(triangle, np.eye(len(own)), lower=True)
    try:
        inverse = np.linalg.inv(own)
    except np.linalg.LinAlgError:
        return None
    condition = np.linalg.norm(own, 1) * np.linalg.norm(inverse, 1)
    return inverse if condition < 1.0 / np.finfo(np.float64).eps else None  # NaN is refused, too


def _pieces(pointers: np.ndarray) -> Iterator[tuple[int, int]]:
    """Ranges of rows with about `_PIECE` entries each, at least one row."""
    start, last = 0, len(pointers) - 1
    while start < last:
        stop = int(np.searchsorted(pointers, pointers[start] + _PIECE, side="right")) - 1
        yield start, (start := min(max(stop, start + 1), last))


def _inside(M: CSR, size: int) -> float:
    """About how many entries lie below the diagonal within blocks; counted in a sample of rows."""
    n = M.shape[0]
    step = -(-n // _SAMPLE)
    found = 0
    for row in range(0, n, step):
        columns = M.pattern.indices[M.pattern.indptr[row] : M.pattern.indptr[row + 1]]
        found += int(np.diff(np.searchsorted(columns, (row - row % size, row)))[0])
    return found * step
