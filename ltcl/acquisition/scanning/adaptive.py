# SPDX-License-Identifier: BSD-3-Clause
"""Hierarchical scanning with cells lit in parallel, after Sen et al. 2005 (dual photography).

The projector is one cell, then four, and so on (`Cells`). A camera pixel that sees more of a cell
under white than `threshold` asks for its four children; the light of other cells stays where it is,
spread evenly over the cell, so that row sums are those of white: T = C W with W the sums over cells
(`ltcl.operators.Pyramid`).

Cells at which no camera pixel is active twice are lit together (`colour_cells`), a child of each at
a time. The light of the other lit cells at a camera pixel is known, and subtracted: C so far, times
W times the pattern. Then the four children e_k, of variances v_k, must add up to the parent e, of
variance v:

    e_k - v_k r / V,    r = sum_k e_k - e,    V = sum_k v_k + v

Known limit: light that stays at a cell is smooth there; details below the threshold are lost, sums
are not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.scanning.columns import all_but_one
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE, PictureLog
from ltcl.acquisition.scanning.pictures import KNOWN_VARIANCE, UNKNOWN, ScanGrid
from ltcl.store import BlockStore, CompressedRecord
from ltcl.transport import first_bounce, stored

# Relative error of the light of other lit cells, which is subtracted.
SUBTRACTION_ERROR = 0.1


@dataclass(frozen=True)
class Cells:
    """The cells of all levels over a `grid` (h, w), numbered as by `ltcl.operators.Pyramid`.

    Level 0 is the pixels; a cell of each further level covers 2 x 2 of the one before, fewer at the
    right and lower rim, until one is left; row-major, the finest level first.

    >>> (Cells((2, 3)).W @ np.arange(6.0))[6:].tolist()  # 0 + 1 + 3 + 4, 2 + 5; all
    [8.0, 7.0, 15.0]
    """

    grid: tuple[int, int]

    @cached_property
    def levels(self) -> tuple[Blocks, ...]:
        """Each level as blocks of pixels."""
        longest = max(self.grid)
        count = (longest - 1).bit_length() + 1
        sides = [min(1 << level, longest) for level in range(count)]
        return tuple(Blocks(self.grid, side) for side in sides)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """The number of the first cell of each level; and of all cells at the end."""
        sizes = [level.grid[0] * level.grid[1] for level in self.levels]
        return (0, *np.cumsum(sizes).tolist())

    @property
    def count(self) -> int:
        """Number of cells of all levels."""
        return self.offsets[-1]

    @property
    def pixels(self) -> int:
        """Number of pixels, the cells of level 0."""
        return self.offsets[1]

    @cached_property
    def W(self) -> scipy.sparse.csr_array:
        """Sums over the cells of all levels, (cells, N) float64."""
        numbers = np.split(np.arange(self.count), self.offsets[1:-1])
        cells = []
        for blocks, level in zip(self.levels, numbers, strict=True):
            cells.append(blocks.enlarged(level.reshape(blocks.grid)))
        pixels = np.tile(np.arange(self.pixels), len(cells))
        places = np.ravel(cells), pixels
        return scipy.sparse.csr_array((np.ones(len(pixels)), places))

    @cached_property
    def areas(self) -> np.ndarray:
        """Pixels of each cell, (cells,)."""
        return np.asarray(self.W.sum(axis=1))

    def children(self, level: int, cells: np.ndarray) -> np.ndarray:
        """(4, n) cells of `level` - 1: upper left, upper right, lower left, lower right; or -1."""
        row, column = np.divmod(cells, self.levels[level].grid[1])
        h, w = self.levels[level - 1].grid
        child_row = 2 * row + np.array([[0], [0], [1], [1]])
        child_column = 2 * column + np.array([[0], [1], [0], [1]])
        exists = (child_row < h) & (child_column < w)
        return np.where(exists, child_row * w + child_column, -1)

    def pattern(self, level: int, cells: np.ndarray) -> np.ndarray:
        """(h, w) float32, 1 on the pixels of some cells of a level."""
        lit = np.zeros(self.levels[level].grid, np.float32)
        lit.flat[cells] = 1.0
        return self.levels[level].enlarged(lit)


@dataclass(frozen=True, kw_only=True)
class Entries:
    """Light of cells at camera pixels.

    Attributes
    ----------
    cell, pixel : (entries,)
        Numbers of cells, in which the entries are sorted, and of camera pixels.
    energy, variance : (channels, entries)
        Light of all pixels of the cell together, and its variance.
    """

    cell: np.ndarray
    pixel: np.ndarray
    energy: np.ndarray
    variance: np.ndarray

    def select(self, mask: np.ndarray) -> Entries:
        """Select entries by a mask (entries,)."""
        return Entries(
            cell=self.cell[mask],
            pixel=self.pixel[mask],
            energy=self.energy[:, mask],
            variance=self.variance[:, mask],
        )


@dataclass(frozen=True, kw_only=True)
class Core:
    """C as far as it is measured: the light of one pixel of a cell, by camera pixel and cell."""

    cells: Cells
    entries: list[Entries]

    def add(self, level: int, entries: Entries) -> None:
        """Add entries that stay at a level."""
        cell = self.cells.offsets[level] + entries.cell
        area = self.cells.areas[cell]
        self.entries.append(
            Entries(
                cell=cell,
                pixel=entries.pixel,
                energy=entries.energy / area,
                variance=entries.variance / area**2,
            )
        )

    def matrices(self) -> list[scipy.sparse.csr_array]:
        """C of each channel, (M, cells), all of one pattern."""
        return self._assemble([entries.energy for entries in self.entries])

    def variances(self) -> list[scipy.sparse.csr_array]:
        """Variances of the entries of C, in the same pattern."""
        return self._assemble([entries.variance for entries in self.entries])

    def _assemble(self, values: list[np.ndarray]) -> list[scipy.sparse.csr_array]:
        row = np.concatenate([entries.pixel for entries in self.entries])
        column = np.concatenate([entries.cell for entries in self.entries])
        shape = self.cells.pixels, self.cells.count
        matrices = []
        for data in np.concatenate(values, axis=1):
            matrices.append(scipy.sparse.csr_array((data, (row, column)), shape=shape))
        return matrices

    def known_entries(self, channel: int) -> Iterator[tuple[np.ndarray, ...]]:
        """Rows, columns, light, and variances of pixels, which have the right sums over cells."""
        C = self.matrices()[channel]
        V = self.variances()[channel]
        variance = np.asarray(V.data)
        by_cell = variance * self.cells.areas[V.indices]
        V.data = np.where(variance < KNOWN_VARIANCE, by_cell, 0.0)
        for start in range(0, self.cells.pixels, BATCH_SIZE):
            rows = slice(start, start + BATCH_SIZE)
            light = (C[rows] @ self.cells.W).toarray()
            light_variance = (V[rows] @ self.cells.W).toarray()
            i, j = np.nonzero(light_variance)
            yield i + start, j, light[i, j], light_variance[i, j]


def most_patterns(cells: Cells) -> int:
    """Number of patterns that no scan exceeds, in whole batches: every cell on its own."""
    batches = -(-np.diff(cells.offsets)[:-1] // BATCH_SIZE)
    return BATCH_SIZE * max(int(batches.sum()), 1)


def scan(grid: ScanGrid, log: PictureLog, threshold: float, sigmas: float) -> Core:
    """Measure the core of T, the white picture of the calibration being its root.

    Cells are divided whose energy is above `threshold` times white, and above `sigmas` standard
    deviations. `log` takes the pictures, or has those of an earlier run.
    """
    white = grid.white
    cells = Cells(grid.grid)
    top = len(cells.levels) - 1
    core = Core(cells=cells, entries=[_diagonal(grid)])
    active = _root(grid)
    smallest = threshold * np.maximum(white.value, 0.0)
    for level in range(top, 0, -1):
        is_bright = active.energy > smallest[:, active.pixel]
        is_clear = active.energy**2 > sigmas**2 * active.variance
        is_divided = np.any(is_bright & is_clear, axis=0) | (level == top)
        core.add(level, active.select(~is_divided))
        division = _Division(core, level, active.select(is_divided))
        active = division.run(grid, log)
    core.add(0, active)
    return core


def _diagonal(grid: ScanGrid) -> Entries:
    """Entries of 0 on the diagonal, which so is in the pattern of C."""
    pixels = np.arange(len(grid.seen))
    zeros = np.zeros((grid.channels, len(pixels)))
    return Entries(cell=pixels, pixel=pixels, energy=zeros, variance=zeros)


def _root(grid: ScanGrid) -> Entries:
    """White as the energy of the one cell of the highest level, at pixels that are seen."""
    seen = np.flatnonzero(grid.seen)
    return Entries(
        cell=np.zeros(len(seen), np.int64),
        pixel=seen,
        energy=grid.white.value[:, seen].astype(np.float64),
        variance=grid.white.variance[:, seen].astype(np.float64),
    )


class _Division:
    """The division of cells of one level into their children.

    `numbers` are the divided cells, `parent` the place of each entry's cell in them; `children`
    (4, cells) are their numbers, or -1.
    """

    def __init__(self, core: Core, level: int, parents: Entries) -> None:
        self.cells = core.cells
        self.matrices = core.matrices()
        self.child_level = level - 1
        self.parents = parents
        numbers, starts, parent = np.unique(parents.cell, return_index=True, return_inverse=True)
        self.numbers = numbers
        self.starts = np.append(starts, len(parent))
        self.parent = parent
        self.children = core.cells.children(level, numbers)

    def run(self, grid: ScanGrid, log: PictureLog) -> Entries:
        """Photograph the children, and return their entries, by cell."""
        groups = self._groups(len(grid.seen))
        log.announce(self._pattern(*group) for group in groups)
        cell = self.children[:, self.parent]
        energy = np.zeros((4, *self.parents.energy.shape))
        # The light is unknown unless a photograph follows.
        variance = energy + np.where(cell >= 0, UNKNOWN, 0.0)[:, None]
        for first in range(0, len(groups), BATCH_SIZE):
            batch = groups[first : first + BATCH_SIZE]
            patterns = [self._pattern(*group) for group in batch]
            pictures = log.take(patterns)
            for group, pattern, picture in zip(batch, patterns, pictures, strict=True):
                child, members = group
                entries = np.flatnonzero(np.isin(self.parent, members))
                pixels = self.parents.pixel[entries]
                known = self._known_light(pattern, pixels)
                noise = picture.variance[:, pixels] + grid.ambient[:, pixels]
                energy[child][:, entries] = picture.value[:, pixels] - known
                variance[child][:, entries] = noise + (SUBTRACTION_ERROR * known) ** 2
        self._add_up(energy, variance)
        return self._sorted_entries(cell, energy, variance)

    def _groups(self, camera_pixels: int) -> list[tuple[int, np.ndarray]]:
        """Cells that are lit together: which child (0 to 3), and of which parents."""
        # The only child of a cell at the rim is the cell: it was photographed as that.
        is_single = np.count_nonzero(self.children >= 0, axis=0) == 1
        colours = colour_cells(self.starts, self.parents.pixel, camera_pixels)
        colours = np.where(is_single, -1, colours)
        groups = []
        for number in range(int(colours.max(initial=-1)) + 1):
            for child in range(4):
                members = np.flatnonzero((colours == number) & (self.children[child] >= 0))
                if len(members):
                    groups.append((child, members))
        return groups

    def _pattern(self, child: int, members: np.ndarray) -> np.ndarray:
        """Pattern (h, w) of one child of each of some parents."""
        return self.cells.pattern(self.child_level, self.children[child, members])

    def _known_light(self, pattern: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Light that stays at cells so far, under a pattern at camera pixels, (channels, n)."""
        sums = self.cells.W @ pattern.ravel()
        return np.stack([(C @ sums)[pixels] for C in self.matrices])

    def _add_up(self, energy: np.ndarray, variance: np.ndarray) -> None:
        """Correct children (4, channels, entries) in place: they add up to their parents."""
        others = all_but_one(variance) + self.parents.variance
        total = np.maximum(variance + others, 1e-300)
        rest = energy.sum(axis=0) - self.parents.energy
        energy -= variance / total * rest
        variance *= others / total

    def _sorted_entries(
        self, cell: np.ndarray, energy: np.ndarray, variance: np.ndarray
    ) -> Entries:
        """Entries of the children that exist, by cell."""
        child, entry = np.nonzero(cell >= 0)
        order = np.argsort(cell[child, entry], kind="stable")
        child = child[order]
        entry = entry[order]
        return Entries(
            cell=cell[child, entry],
            pixel=self.parents.pixel[entry],
            energy=energy[child, :, entry].T,
            variance=variance[child, :, entry].T,
        )


def finish(
    store: BlockStore, grid: ScanGrid, core: Core, mixing: np.ndarray | None, sigmas: float
) -> None:
    """Make the compressed transport of a scan's core, which replaces its pictures in the store."""
    for channel, variance in enumerate(core.variances()):
        store.extra(f"core_variance_{channel}", variance.data)
    arrays = transport_arrays(core, mixing, sigmas) | grid.noise(core.known_entries)
    store.finalize(compressed=CompressedRecord(arrays))


def transport_arrays(
    core: Core, mixing: np.ndarray | None = None, sigmas: float = 0.0
) -> dict[str, np.ndarray]:
    """The arrays of a scan as a compressed transport (`ltcl.transport`).

    It is S = I + (C W - I): C W - I is C less 1 at every pixel's own cell. Its first bounce is 0,
    so that the pixel can be masked, where it is not above 0 by `sigmas` standard deviations.
    """
    cells = core.cells
    matrices = core.matrices()
    diagonal = np.stack([_diagonal_of_product(C, cells) for C in matrices])
    noise = np.stack([_diagonal_of_product(V, cells) for V in core.variances()])
    remainders = []
    for C in matrices:
        row = np.repeat(np.arange(len(C.indptr) - 1), np.diff(C.indptr))
        # A pixel's own cell has its number.
        values = C.data - (C.indices == row)
        remainders.append(scipy.sparse.csr_array((values, C.indices, C.indptr), shape=C.shape))
    return stored.arrays_of_scan(
        cells.grid,
        remainders,
        diagonal - 1.0,
        first_bounce.drop_uncertain(diagonal, noise, sigmas),
        mixing,
    )


def _diagonal_of_product(C: scipy.sparse.csr_array, cells: Cells) -> np.ndarray:
    """Diagonal of C W, (N,)."""
    return C.multiply(cells.W.T).sum(axis=1)


def colour_cells(starts: np.ndarray, pixels: np.ndarray, count: int) -> np.ndarray:
    """Colours (n,) from 0 of n cells: no camera pixel is active in two of one colour.

    Greedy (Sen et al. 2005): the cells with most active pixels first, each into the first colour
    that is free. Cell k is active at the camera pixels ``pixels[starts[k]:starts[k + 1]]``, of
    `count`.
    """
    colours = np.zeros(len(starts) - 1, np.int64)
    used = np.full(count, 0, object)  # a bit for each colour
    for cell in np.argsort(-np.diff(starts), kind="stable"):
        active = pixels[starts[cell] : starts[cell + 1]]
        bits = np.bitwise_or.reduce(used[active], initial=0)
        lowest_free_bit = ~bits & (bits + 1)
        colours[cell] = lowest_free_bit.bit_length() - 1
        used[active] |= 1 << int(colours[cell])
    return colours
