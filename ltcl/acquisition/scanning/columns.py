# SPDX-License-Identifier: BSD-3-Clause
"""Columns of T, batch by batch: patterns, decoding, thresholds, and rows that add up to white.

A batch is a block of columns of the store: pixels that follow each other. Its photographs depend on
nothing but the calibration, so that a scan which was stopped goes on with the next block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.scanning.pictures import KNOWN_VARIANCE, Picture, ScanCamera, ScanGrid
from ltcl.errors import InputError, ScanRefused
from ltcl.store import BlockStore

# Ratio of the sides of tiles, from one to the next, whose sums are tested.
TILE_RATIO = 4
# Columns that share light that only their sum shows (with 16 errors of bounces are 1.25 times as
# large as forecast).
SHARED_COLUMNS = 8
# Relative deviation of row sums from white above which a scan is refused.
MAX_SUM_DEVIATION = 0.3
ROW_SUMS = "scanned.sums"
"""Extra array (channels, N) of a store: row sums of T by its columns, before they were made to
add up."""


@dataclass(frozen=True)
class Pixels:
    """Batches of `size` pixels, one at a time, and all of them at once, which is brighter.

    Without that, T p deviates by 1.5 % instead of 0.6 % (`bench/acquire.py`, 16 x 16 pixels and 8
    bits). B pictures x_j and the one of all, G, have variances v_j and g; the same ambient light of
    variance a is subtracted from each. The rest r = sum_j x_j - G has the variance
    R = sum_j v_j + g + (B - 1)^2 a. The best columns are

        x_j - (v_j + (B - 1) a) r / R,    of variance v_j + a - (v_j + (B - 1) a)^2 / R

    >>> Pixels(2).patterns(2).tolist()
    [[True, False], [False, True], [True, True]]
    >>> x, v = Pixels(2).decode(np.array([[1.0], [2.0], [3.6]]), np.ones((3, 1)), np.zeros(1))
    >>> x.round(3).tolist(), v.round(3).tolist()
    ([[1.2], [2.2]], [[0.667], [0.667]])
    """

    size: int = 64

    def patterns(self, pixels: int) -> np.ndarray:
        """Patterns of a batch: the pixels that are on, (patterns, pixels) bool."""
        single = np.eye(pixels, dtype=bool)
        if pixels == 1:
            return single
        return np.concatenate([single, np.ones((1, pixels), bool)])

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns of T and their variance, (pixels, M), from pictures (patterns, M).

        `ambient` (M,) is the variance of the ambient light.
        """
        if len(value) == 1:
            return value, variance + ambient
        x = value[:-1].astype(np.float64)
        v = variance[:-1].astype(np.float64)
        B = len(x)
        shared = (B - 1) * ambient
        rest = x.sum(axis=0) - value[-1]
        others = all_but_one(v) + variance[-1] + (B - 1) * shared  # R = v_j + others
        R = np.maximum(v + others, 1e-300)
        first_part = v / R * (others + ambient - 2 * shared)
        second_part = (ambient * others - shared**2) / R
        columns = x - (v + shared) / R * rest
        return columns, np.maximum(first_part + second_part, 0.0)

    def correlation(self, variance: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """Correlation (M,) of the errors of two columns.

        It is taken as 0, though the error of the sum of all columns is smaller.
        """
        return np.zeros(variance.shape[1:])


def all_but_one(v: np.ndarray) -> np.ndarray:
    """Sums over the first axis without the entry itself.

    They are exact also where that entry is larger than all others.
    """
    return np.tensordot(1.0 - np.eye(len(v)), v, 1)


@dataclass(frozen=True)
class Hadamard:
    """Batches of `size` = n = 2^k - 1 pixels, under S-matrices; InputError for another size.

    With H the Sylvester matrix of order n + 1, S = (1 - H) / 2 without the first row and column has
    (n + 1) / 2 pixels on in every row; its inverse is 2 / (n + 1) (2 S^T - 1). Each column has the
    variance 4 / (n + 1)^2 (V + a), with V = sum_k v_k and a of the ambient light: better than one
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
        """Patterns of a batch: the pixels that are on, (patterns, pixels) bool.

        For fewer pixels: columns of the smallest matrix that has as many.
        """
        order = (1 << pixels.bit_length()) - 1
        return _s_matrix(order)[:, :pixels]

    def decode(
        self, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns of T and their variance, as many as patterns; those beyond the batch are 0.

        Arguments are as for `Pixels.decode`.
        """
        n = len(value)
        inverse = (2.0 * _s_matrix(n) - 1.0).T
        x = 2.0 / (n + 1) * (inverse @ value)
        total = variance.sum(axis=0, dtype=np.float64) + ambient
        v = 4.0 / (n + 1) ** 2 * total
        return x, np.broadcast_to(v, x.shape)

    def correlation(self, variance: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """Correlation (M,) of the errors of two columns."""
        V = variance.sum(axis=0, dtype=np.float64)
        return (ambient - V / len(variance)) / np.maximum(V + ambient, 1e-300)


def _s_matrix(n: int) -> np.ndarray:
    return scipy.linalg.hadamard(n + 1)[1:, 1:] < 0


Code = Pixels | Hadamard


def choose_code(strategy: str, grid: tuple[int, int], order: int) -> Code:
    """The code of a strategy, for at least two batches.

    So no pattern is white, which is photographed in the calibration.
    """
    half = max(1, grid[0] * grid[1] // 2)
    if strategy == "hadamard":
        largest_order = (1 << (half.bit_length() - 1)) - 1
        return Hadamard(min(order, max(1, largest_order)))
    return Pixels(min(Pixels.size, half))


def count_patterns(code: Code, pixels: int) -> int:
    """Number of patterns for so many pixels."""
    batches, rest = divmod(pixels, code.size)
    patterns = batches * len(code.patterns(code.size))
    if rest:
        patterns += len(code.patterns(rest))
    return patterns


class ColumnScan:
    """Photographs columns of T into a store: every block of columns that is not there yet."""

    def __init__(self, camera: ScanCamera, code: Code, store: BlockStore, sigmas: float) -> None:
        self.camera = camera
        self.code = code
        self.store = store
        self.sigmas = sigmas

    def run(self, progress: Callable[[int], None]) -> None:
        """Photograph, decode and commit all blocks that are missing.

        `progress` is called with the number of patterns of earlier runs, then with 1 for each.
        """
        missing = sorted({block for _, block in self.store.missing()})
        blocks = self.store.layout.blocks("columns")
        counts = np.array([self._count_patterns(block) for block in range(blocks)])
        progress(int(counts.sum() - counts[missing].sum()))

        patterns = chain.from_iterable(map(self._patterns, missing))
        self.camera.announce(patterns, int(counts.max()))
        for block in missing:
            pictures = self.camera.take(self._patterns(block), progress)
            self.camera.keep_lamp_gain(self.store)
            self._commit(block, pictures)

    def _count_patterns(self, block: int) -> int:
        return len(self.code.patterns(self._pixels(block)))

    def _pixels(self, block: int) -> int:
        """Number of columns of a block."""
        start, stop = self.store.layout.span(block, "columns")
        return stop - start

    def _patterns(self, block: int) -> Iterator[np.ndarray]:
        """The patterns (h, w) of a block."""
        start, _ = self.store.layout.span(block, "columns")
        for lit in self.code.patterns(self._pixels(block)):
            pattern = np.zeros(self.camera.grid, np.float32)
            pattern.flat[start + np.flatnonzero(lit)] = 1.0
            yield pattern

    def _commit(self, block: int, pictures: Sequence[Picture]) -> None:
        """Decode pictures, drop noise, and write the columns of each channel."""
        pixels = self._pixels(block)
        for c in range(self.camera.channels):
            value = np.stack([picture.value[c] for picture in pictures])
            variance = np.stack([picture.variance[c] for picture in pictures])
            ambient = self.camera.ambient[c]
            x, v = self.code.decode(value, variance, ambient)
            x = x[:pixels]
            v = v[:pixels]
            correlation = self.code.correlation(variance, ambient)
            x, keep = significant(x, v, self.camera.grid, self.sigmas, correlation)
            keep &= self.camera.seen
            v = v[keep]
            is_known = v < KNOWN_VARIANCE
            values = np.where(is_known, x[keep], 0.0).astype(np.float32)
            entries = values, np.nonzero(keep)
            matrix = scipy.sparse.csr_array(entries, shape=x.shape)
            self.store.write(c, block, matrix, np.where(is_known, v, np.nan))


def finish(store: BlockStore, grid: ScanGrid, patterns: int, sigmas: float) -> None:
    """Make the transport of the columns in a store, whose rows then add up to white.

    ScanRefused if they deviate from white by far: the scene changed, or a camera with one exposure
    changes that by itself. Others are refused in a batch.
    """
    white = grid.white
    sums = np.stack([_row_sums(store, c) for c in range(grid.channels)])
    relative = deviation(sums, white)
    if relative > MAX_SUM_DEVIATION:
        raise ScanRefused(
            f"{store.path}: row sums of T deviate by {relative:.0%} from white "
            f"(allowed: {MAX_SUM_DEVIATION:.0%}); the scene, the light or the exposure changed "
            "during the scan: acquire into another store"
        )
    store.extra(ROW_SUMS, sums)
    store.update(patterns=patterns)
    noise = grid.noise(lambda channel: _known_entries(store, channel))
    for name, array in noise.items():
        store.extra(name, array)

    def add_up(
        channel: int, first: int, matrix: Any, variance: np.ndarray
    ) -> tuple[scipy.sparse.csr_array, np.ndarray]:
        rows = slice(first, first + matrix.shape[0])
        expected = Picture(white.value[channel, rows], white.variance[channel, rows])
        return balance(matrix, variance, expected)

    store.finalize(sigmas=sigmas, change=add_up)


def significant(
    value: np.ndarray,
    variance: np.ndarray,
    grid: tuple[int, int],
    sigmas: float = 3.0,
    correlation: np.ndarray | float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Find entries (k, M) of k columns that are light, not noise of the sensor: sums are tested.

    An entry more than `sigmas` standard deviations from 0 counts, or one of unknown variance. Of
    the others, all entries of a tile of 4 x 4 pixels count if their sum does, then of 16 x 16, and
    so on to the whole grid (h, w); then the same over all columns: without, bounces 2 and 3 deviate
    by two to three times their forecast (`bench/acquire.py`). Both signs are treated alike: no
    bias. 0 keeps everything.

    `correlation` (M,) is that of errors of two columns of one variance: far light of S-matrices,
    which is significant only in the sum of a batch, is lost without it (7 % of the light in a
    colour of 32 x 32 pixels and 8 bits).

    Entries that count only in sums over all columns become the mean of `SHARED_COLUMNS`
    neighbouring columns: what tells these apart is noise. With S-matrices in colours it is 0.4 % of
    T p.

    Returns
    -------
    value, keep : (k, M)
        The entries, and which of them are light.
    """
    if checks.number("sigmas", sigmas, least=0.0) == 0.0:
        return value, np.ones(value.shape, bool)
    keep = (variance >= KNOWN_VARIANCE) | (value**2 > sigmas**2 * variance)
    sides = _tile_sides(grid)

    noise = variance, correlation

    # 1. Tiles of each column.
    for side in sides:
        tiles = Blocks(grid, side)
        keep |= _significant_tiles(value, noise, keep, tiles, sigmas, 1)

    # 2. Tiles of all columns together.
    single = keep.copy()
    for side in sides:
        tiles = Blocks(grid, side)
        keep |= _significant_tiles(value, noise, keep, tiles, sigmas, len(value))

    together = keep & ~single
    mean = _shared_mean(value, together)
    return np.where(together, mean, value), keep


def _tile_sides(grid: tuple[int, int]) -> list[int]:
    """Sides of the tiles: 4, 16, ... pixels, and the whole grid."""
    sides = []
    side = TILE_RATIO
    while side < max(grid):
        sides.append(side)
        side *= TILE_RATIO
    return [*sides, max(grid)]


def _significant_tiles(
    value: np.ndarray,
    noise: tuple[np.ndarray, np.ndarray | float],
    keep: np.ndarray,
    tiles: Blocks,
    sigmas: float,
    columns: int,
) -> np.ndarray:
    """Entries in tiles whose sum, of entries not kept before, is light.

    `noise` is the variance of entries and the correlation of their errors; sums are over so many
    `columns`. Returns (k / columns, M) bool, to be broadcast.
    """
    variance, correlation = noise
    grid = tiles.pixels

    def column_sums(entries: np.ndarray) -> np.ndarray:
        tested = np.where(keep, 0.0, entries)
        return tested.reshape(-1, columns, value.shape[1]).sum(axis=1)

    def tile_sums(entries: np.ndarray) -> np.ndarray:
        return tiles.sum(np.moveaxis(entries.reshape(-1, *grid), 0, -1))

    terms = column_sums(np.ones_like(value))
    sum_variance = column_sums(variance)
    sum_variance *= 1.0 + correlation * np.maximum(terms - 1.0, 0.0)
    light = tile_sums(column_sums(value))
    is_light = light**2 > sigmas**2 * tile_sums(sum_variance)
    pixels = tiles.enlarged(is_light.astype(np.float32)) > 0
    return np.moveaxis(pixels, -1, 0).reshape(-1, value.shape[1])


def _shared_mean(value: np.ndarray, together: np.ndarray) -> np.ndarray:
    """Means (k, M) over neighbouring columns, of the entries that count only together."""
    starts = np.arange(0, len(value), SHARED_COLUMNS)
    light = np.add.reduceat(np.where(together, value, 0.0), starts, axis=0)
    terms = np.add.reduceat(together, starts, axis=0, dtype=value.dtype)
    mean = light / np.maximum(terms, 1.0)
    return np.repeat(mean, SHARED_COLUMNS, axis=0)[: len(value)]


def _known_entries(store: BlockStore, channel: int) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns, entries of T and their variances, of all known entries in a store."""
    for number in range(store.layout.blocks("columns")):
        # Batches of a scan have variances.
        block: Any = store.block(channel, number)
        C = block.matrix
        variance = block.variance
        first, _ = store.layout.span(number, "columns")
        column = first + np.repeat(np.arange(C.shape[0]), np.diff(C.indptr))
        known = np.isfinite(variance)
        yield C.indices[known], column[known], C.data[known], variance[known]


def _row_sums(store: BlockStore, channel: int) -> np.ndarray:
    """Row sums (M,) of the columns in a store, float64."""
    sums = []
    for block in range(store.layout.blocks("columns")):
        matrix = store.block(channel, block).matrix
        sums.append(matrix.sum(axis=0, dtype=np.float64))
    return np.sum(sums, axis=0)


def deviation(sums: np.ndarray, white: Picture) -> float:
    """Relative root mean square deviation of row sums (channels, N) from white.

    NaN without light.
    """
    light = np.sum(white.value[white.known] ** 2, dtype=np.float64)
    difference = (sums - white.value)[white.known]
    if light <= 0:
        return float("nan")
    return float(np.sqrt(np.sum(difference**2) / light))


def balance(
    matrix: scipy.sparse.csr_array, variance: np.ndarray, white: Picture
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """Make rows of T (rows, N) add up to white (rows,); `variance` (nnz,) is that of their entries.

    White is photographed many times, while N columns add up whatever is wrong with each: light that
    thresholds dropped, and an error of the ambient light. For a row with entries x_j of variance
    v_j and white w of variance u the best estimate, with independent errors, is

        x_j + v_j r / (V + u),    of variance v_j - v_j^2 / (V + u)

        r = w - sum_j x_j,        V = sum_j v_j

    Dropped entries count in V, each with the median v_j of its row; their part of r goes to the
    others. Rows stay as they are where white, or an entry of theirs, is not known (NaN).

    >>> T = scipy.sparse.csr_array([[0.5, 0.1]])
    >>> rows, v = balance(T, np.array([3.0, 1.0]), Picture(np.array([0.7]), np.array([1.0])))
    >>> rows.toarray().round(3).tolist(), v.round(3).tolist()
    ([[0.56, 0.12]], [1.2, 0.8])
    """
    lengths = np.diff(matrix.indptr)
    shape: Any = matrix.shape
    rows, N = shape
    places = matrix.indices, matrix.indptr
    V: Any = scipy.sparse.csr_array((variance, *places), shape=matrix.shape)
    median = np.zeros(rows)
    for row, entries in enumerate(np.split(variance, matrix.indptr[1:-1])):
        if len(entries):
            median[row] = np.median(entries)
    stored = np.asarray(V.sum(axis=1))
    dropped = median * (N - lengths)
    total = stored + dropped + white.variance
    known = np.isfinite(total) & white.known & (stored > 0)
    stored = np.where(known, stored, 1.0)
    total = np.where(known, total, np.inf)
    rest = white.value - matrix.sum(axis=1)
    move = np.where(known, rest * (1.0 + dropped / stored) / total, 0.0)
    # Unknown entries are in rows that stay.
    spread = np.nan_to_num(variance)
    values = matrix.data + spread * np.repeat(move, lengths)
    balanced = scipy.sparse.csr_array((values, *places), shape=matrix.shape)
    return balanced, variance - spread**2 / np.repeat(total, lengths)
