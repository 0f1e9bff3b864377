# SPDX-License-Identifier: BSD-3-Clause
"""Columns of T, batch by batch: patterns, decoding, thresholds, and rows that add up to white.

A batch is a block of columns of the store: pixels that follow each other. Its photographs depend on
nothing but the calibration, so that a scan which was stopped goes on with the next block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture, Pictures
from ltcl.errors import InputError
from ltcl.store import BlockStore

_KNOWN = 1e-3 * UNKNOWN  # variances from there on are of unknown values
_TILE = 4  # sides of tiles, from one to the next
# columns that share light that only their sum shows (16: errors of bounces 1.25 times as forecast)
_RUN = 8
SUMS = "scanned.sums"
"""Extra array (channels, N) of a store: row sums of T by its columns, before they were made to add up."""


def scan(
    pictures: Pictures,
    code: Code,
    store: BlockStore,
    sigmas: float,
    progress: Callable[[int], None],
) -> None:
    """Photograph, decode and commit every block of columns that is not in the store.

    `sigmas` is that of `significant`. `progress` is called with the number of patterns of earlier
    runs, then with 1 for each.
    """
    missing = sorted({block for _, block in store.missing()})
    spans = [store.layout.span(block, "columns") for block in range(store.layout.blocks("columns"))]
    counts = [len(code.patterns(stop - start)) for start, stop in spans]
    progress(sum(counts) - sum(counts[block] for block in missing))

    def patterns(block: int) -> Iterator[np.ndarray]:
        start, stop = spans[block]
        for lit in code.patterns(stop - start):
            pattern = np.zeros(pictures.grid, np.float32)
            pattern.flat[start + np.flatnonzero(lit)] = 1.0
            yield pattern

    pictures.announce((p for block in missing for p in patterns(block)), max(counts))
    for block in missing:
        batch = pictures.take(patterns(block), progress)
        for c in range(pictures.channels):
            value, variance = np.stack(
                [(image.value[c], image.variance[c]) for image in batch], axis=1
            )
            x, v = code.decode(value, variance, pictures.ambient[c])
            start, stop = spans[block]
            x, v = x[: stop - start], v[: stop - start]
            r = code.correlation(variance, pictures.ambient[c])
            x, keep = significant(x, v, pictures.grid, sigmas, r)
            keep &= pictures.seen
            known = v[keep] < _KNOWN
            values = np.where(known, x[keep], 0.0).astype(np.float32)
            matrix = scipy.sparse.csr_array((values, np.nonzero(keep)), shape=x.shape)
            store.write(c, block, matrix, np.where(known, v[keep], np.nan))


@dataclass(frozen=True)
class Pixels:
    """Batches of `size` pixels, one at a time, and all of them at once, which is brighter.

    Without that, T p deviates by 1.5 % in place of 0.6 (`bench/acquire.py`, 16 x 16 pixels and 8
    bits). Of B pictures x_j and that of all, G, of variances v_j and g, less the same ambient light
    of variance a, the rest r = sum_j x_j - G has the variance R = sum_j v_j + g + (B - 1)^2 a. The
    best columns are

        x_j - (v_j + (B - 1) a) r / R,    of variance v_j + a - (v_j + (B - 1) a)^2 / R

    >>> Pixels(2).patterns(2).tolist()
    [[True, False], [False, True], [True, True]]
    >>> x, v = Pixels(2).decode(np.array([[1.0], [2.0], [3.6]]), np.ones((3, 1)), np.zeros(1))
    >>> x.round(3).tolist(), v.round(3).tolist()
    ([[1.2], [2.2]], [[0.667], [0.667]])
    """

    size: int = 64

    def patterns(self, pixels: int) -> np.ndarray:
        """(patterns, pixels) bool: which pixels of a batch are on."""
        single = np.eye(pixels, dtype=bool)
        return np.concatenate([single, np.ones((1, pixels), bool)]) if pixels > 1 else single

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns of T and their variance, (pixels, M), from pictures (patterns, M); `ambient` (M,) is a."""
        if len(value) == 1:
            return value, variance + ambient
        x, v, B = value[:-1].astype(np.float64), variance[:-1].astype(np.float64), len(value) - 1
        shared = (B - 1) * ambient
        rest = x.sum(axis=0) - value[-1]
        others = all_but_one(v) + variance[-1] + (B - 1) * shared  # R = v_j + others
        R = np.maximum(v + others, 1e-300)
        spread = v / R * (others + ambient - 2 * shared) + (ambient * others - shared**2) / R
        return x - (v + shared) / R * rest, np.maximum(spread, 0.0)

    def correlation(self, variance: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """(M,), of the errors of two columns: taken as 0, though that of the sum of all is smaller."""
        return np.zeros(variance.shape[1:])


def all_but_one(v: np.ndarray) -> np.ndarray:
    """Sums over the first axis without the entry itself, exact where that is larger than all others."""
    return np.tensordot(1.0 - np.eye(len(v)), v, 1)


@dataclass(frozen=True)
class Hadamard:
    """Batches of `size` = n = 2^k - 1 pixels, under S-matrices; InputError of another size.

    With H the Sylvester matrix of order n + 1, S = (1 - H) / 2 without the first row and column has
    (n + 1) / 2 pixels on in every row; its inverse is 2 / (n + 1) (2 S^T - 1). Each column has the
    variance 4 / (n + 1)^2 (V + a), of V = sum_k v_k and the ambient light's a: better than one
    pixel at a time where noise does not depend on the light, worse where it is that of photons. Two
    columns have the correlation (a - V / n) / (V + a): errors nearly cancel in the sum of all.

    >>> Hadamard(3).patterns(3).astype(int).tolist()
    [[1, 0, 1], [0, 1, 1], [1, 1, 0]]
    >>> T = np.array([[0.5], [0.1], [0.2]])
    >>> x, v = Hadamard(3).decode(Hadamard(3).patterns(3) @ T, np.ones((3, 1)), np.zeros(1))
    >>> x.round(9).ravel().tolist(), v.ravel().tolist()
    ([0.5, 0.1, 0.2], [0.75, 0.75, 0.75])
    """

    size: int = 63

    def __post_init__(self) -> None:
        if checks.count("size", self.size) & (self.size + 1):
            raise InputError(f"size is {self.size}; it must be 2^k - 1: 1, 3, 7, 15, ...")

    def patterns(self, pixels: int) -> np.ndarray:
        """As of `Pixels`: of fewer pixels, columns of the smallest matrix that has as many."""
        return _s_matrix((1 << pixels.bit_length()) - 1)[:, :pixels]

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """As of `Pixels`: of as many pixels as patterns, those beyond the batch being 0."""
        n = len(value)
        x = 2.0 / (n + 1) * ((2.0 * _s_matrix(n) - 1.0).T @ value)
        v = 4.0 / (n + 1) ** 2 * (variance.sum(axis=0, dtype=np.float64) + ambient)
        return x, np.broadcast_to(v, x.shape)

    def correlation(self, variance: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """(M,), of the errors of two columns."""
        V = variance.sum(axis=0, dtype=np.float64)
        return (ambient - V / len(variance)) / np.maximum(V + ambient, 1e-300)


def _s_matrix(n: int) -> np.ndarray:
    return scipy.linalg.hadamard(n + 1)[1:, 1:] < 0


Code = Pixels | Hadamard


def code_of(strategy: str, grid: tuple[int, int], order: int) -> Code:
    """The code of a strategy, for two batches at least: no pattern is white, which is photographed."""
    half = max(1, grid[0] * grid[1] // 2)
    if strategy == "hadamard":
        return Hadamard(min(order, max(1, (1 << (half.bit_length() - 1)) - 1)))
    return Pixels(min(Pixels().size, half))


def patterns(code: Code, n: int) -> int:
    """Patterns for n pixels."""
    whole, rest = divmod(n, code.size)
    return whole * len(code.patterns(code.size)) + (len(code.patterns(rest)) if rest else 0)


def significant(
    value: np.ndarray,
    variance: np.ndarray,
    grid: tuple[int, int],
    sigmas: float = 3.0,
    correlation: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Entries (k, M) of k columns, and which are light, not noise of the sensor: sums are tested.

    An entry more than `sigmas` standard deviations from 0 counts, or one of unknown variance. Of
    the others, all entries of a tile of 4 x 4 pixels count where their sum is, then of 16 x 16, and
    so on to the whole grid (h, w); then the same over all columns: without, bounces 2 and 3 deviate
    by two to three times their forecast (`bench/acquire.py`). Both signs are treated alike: no
    bias. 0 keeps everything. `correlation` (M,) is that of errors of two columns of one variance:
    far light of S-matrices, which is significant only in the sum of a batch, is lost without it (7
    % of the light in a colour of 32 x 32 pixels and 8 bits).

    Entries that count in sums over all columns only become the mean of `_RUN` neighbouring columns:
    what tells these apart is noise. Of S-matrices in colours it is 0.4 % of T p.
    """
    if checks.number("sigmas", sigmas, least=0.0) == 0.0:
        return value, np.ones(value.shape, bool)
    keep = (variance >= _KNOWN) | (value**2 > sigmas**2 * variance)
    sides = [_TILE**k for k in range(1, 16) if _TILE**k < max(grid)]
    for columns in (1, len(value)):
        own = keep.copy()
        for tiles in (Blocks(grid, side) for side in [*sides, max(grid)]):
            light, noise, terms = (
                np.where(keep, 0.0, x).reshape(-1, columns, value.shape[1]).sum(axis=1)
                for x in (value, variance, np.ones_like(value))
            )
            noise *= 1.0 + correlation * np.maximum(terms - 1.0, 0.0)
            total, noise = (
                tiles.sum(np.moveaxis(x.reshape(-1, *grid), 0, -1)) for x in (light, noise)
            )
            far = tiles.enlarged((total**2 > sigmas**2 * noise).astype(np.float32)) > 0
            keep |= np.moveaxis(far, -1, 0).reshape(-1, value.shape[1])
    together = keep & ~own
    starts = np.arange(0, len(value), _RUN)
    light, terms = (
        np.add.reduceat(np.where(together, x, 0.0), starts, axis=0)
        for x in (value, np.ones_like(value))
    )
    mean = np.repeat(light / np.maximum(terms, 1.0), _RUN, axis=0)[: len(value)]
    return np.where(together, mean, value), keep


def variances(store: BlockStore, channel: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns, entries of T and their variances, of all columns in a store that are known."""
    for block in range(store.layout.blocks("columns")):
        C, V = store.block(channel, block)
        j = (
            np.repeat(np.arange(C.shape[0]), np.diff(C.indptr))
            + store.layout.span(block, "columns")[0]
        )
        yield tuple(x[np.isfinite(V)] for x in (C.indices, j, C.data, V))


def sums(store: BlockStore, channel: int) -> np.ndarray:
    """Row sums (M,) of the columns in a store, float64."""
    blocks = range(store.layout.blocks("columns"))
    return np.sum(
        [store.block(channel, b).matrix.sum(axis=0, dtype=np.float64) for b in blocks], axis=0
    )


def deviation(sums: np.ndarray, white: Picture) -> float:
    """Relative root mean square deviation of row sums (channels, N) from white, NaN without light."""
    light = np.sum(white.value[white.known] ** 2, dtype=np.float64)
    difference = (sums - white.value)[white.known]
    return float(np.sqrt(np.sum(difference**2) / light)) if light > 0 else float("nan")


def balance(
    matrix: scipy.sparse.csr_array, variance: np.ndarray, white: Picture
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """Rows of T (rows, N) and the variance (nnz,) of their entries, which add up to white (rows,).

    White is photographed many times, while N columns add up whatever is wrong with each: what
    thresholds dropped, and an error of the ambient light. Of a row with entries x_j of variance v_j
    and white w of variance u the best estimate, for independent errors, is

        x_j + v_j r / (V + u),    of variance v_j - v_j^2 / (V + u),    r = w - sum_j x_j,    V =
        sum_j v_j

    Entries that were dropped count in V, each with the median v_j of its row; their part of r goes
    to the others. Rows stay as they are where white is not known, or an entry of theirs is not
    (NaN).

    >>> T = scipy.sparse.csr_array([[0.5, 0.1]])
    >>> rows, v = balance(T, np.array([3.0, 1.0]), Picture(np.array([0.7]), np.array([1.0])))
    >>> rows.toarray().round(3).tolist(), v.round(3).tolist()
    ([[0.56, 0.12]], [1.2, 0.8])
    """
    V: Any = scipy.sparse.csr_array((variance, matrix.indices, matrix.indptr), shape=matrix.shape)
    each = np.diff(matrix.indptr)
    median = [np.median(v) if len(v) else 0.0 for v in np.split(variance, matrix.indptr[1:-1])]
    stored, dropped = V.sum(axis=1), np.array(median) * (V.shape[1] - each)
    total = stored + dropped + white.variance
    known = np.isfinite(total) & white.known & (stored > 0)
    stored, total = np.where(known, stored, 1.0), np.where(known, total, np.inf)
    move = np.where(
        known, (white.value - matrix.sum(axis=1)) * (1.0 + dropped / stored) / total, 0.0
    )
    spread = np.nan_to_num(variance)  # unknown ones are in rows that stay
    values = matrix.data + spread * np.repeat(move, each)
    rows = scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=matrix.shape)
    return rows, variance - spread**2 / np.repeat(total, each)
