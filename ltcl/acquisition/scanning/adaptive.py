# SPDX-License-Identifier: BSD-3-Clause
"""Hierarchical scanning with cells lit in parallel, after Sen et al. 2005 (dual photography).

The projector is one cell, then four, and so on (`Cells`). A camera pixel that sees more of a cell under white
than `threshold` asks for its four children; the light of other cells stays where it is, spread evenly over
the cell, so that row sums are those of white: T = C W with W the sums over cells (`ltcl.operators.Pyramid`).

Cells at which no camera pixel is active twice are lit together (`colour`), a child of each at a time. What
camera pixels see of the other lit cells is known, and subtracted: C so far, times W times the pattern. Then
the four children e_k, of variances v_k, must add up to the parent e, of variance v:

    e_k - v_k r / V,    r = sum_k e_k - e,    V = sum_k v_k + v

Known limit: light that stays at a cell is smooth there; details below the threshold are lost, sums are not.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import first_bounce
from ltcl.acquisition.geometry.resample import Blocks
from ltcl.acquisition.scanning.columns import all_but_one
from ltcl.acquisition.scanning.pictures import UNKNOWN, Log, Seen
from ltcl.store import BlockStore

AT_ONCE = 16  # patterns of a batch
_SUBTRACTED = 0.1  # relative error of what is subtracted for other lit cells


@dataclass(frozen=True)
class Cells:
    """The cells of all levels over a `grid` (h, w), numbered as by `ltcl.operators.Pyramid`.

    Level 0 is the pixels; a cell of each further level covers 2 x 2 of the one before, fewer at the right and
    lower rim, until one is left; row-major, the finest level first.

    >>> Cells((2, 3)).sums(np.arange(6.0)[:, None])[6:, 0].tolist()  # 0 + 1 + 3 + 4, 2 + 5; all
    [8.0, 7.0, 15.0]
    """

    grid: tuple[int, int]

    @cached_property
    def levels(self) -> tuple[Blocks, ...]:
        """Each level as blocks of pixels."""
        side = max(self.grid)
        count = (side - 1).bit_length() + 1
        return tuple(Blocks(self.grid, min(1 << level, side)) for level in range(count))

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """The number of the first cell of each level; and of all cells at the end."""
        return (0, *np.cumsum([level.grid[0] * level.grid[1] for level in self.levels]).tolist())

    def sums(self, x: np.ndarray) -> np.ndarray:
        """Sums of the columns of (N, k) over the cells of all levels, (cells, k)."""
        picture = np.reshape(x, (*self.grid, -1)).astype(np.float64)
        levels = [picture]
        for blocks in self.levels[:-1]:
            levels.append(Blocks(blocks.grid, 2).sum(levels[-1]))
        return np.concatenate([level.reshape(-1, picture.shape[2]) for level in levels])

    def children(self, level: int, cells: np.ndarray) -> np.ndarray:
        """(4, n) cells of `level` - 1: upper left, upper right, lower left, lower right; or -1."""
        row, column = np.divmod(cells, self.levels[level].grid[1])
        h, w = self.levels[level - 1].grid
        r, c = 2 * row + np.array([[0], [0], [1], [1]]), 2 * column + np.array([[0], [1], [0], [1]])
        return np.where((r < h) & (c < w), r * w + c, -1)

    def pattern(self, level: int, cells: np.ndarray) -> np.ndarray:
        """(h, w) float32, 1 on the pixels of some cells of a level."""
        lit = np.zeros(self.levels[level].grid, np.float32)
        lit.flat[cells] = 1.0
        return self.levels[level].enlarged(lit)

    def of_pixels(self) -> np.ndarray:
        """(levels, N) the cell of each level that a pixel is in, counted over all levels."""
        numbers = np.split(np.arange(self.offsets[-1]), self.offsets[1:-1])
        cells = [b.enlarged(level.reshape(b.grid)) for b, level in zip(self.levels, numbers, strict=True)]
        return np.reshape(cells, (len(cells), -1))


class Entries(NamedTuple):
    """Light of cells at camera pixels, (entries,), by cell; energy and variance are (channels, entries).

    Energy is that of all pixels of the cell together.
    """

    cell: np.ndarray
    pixel: np.ndarray
    energy: np.ndarray
    variance: np.ndarray

    def where(self, mask: np.ndarray) -> Entries:
        """Some of them."""
        return Entries(self.cell[mask], self.pixel[mask], self.energy[:, mask], self.variance[:, mask])


@dataclass(frozen=True, eq=False)
class Core:
    """C as far as it is measured: the light of one pixel of a cell, by camera pixel and cell."""

    cells: Cells
    channels: int
    entries: list[Entries] = field(default_factory=list)

    def add(self, level: int, entries: Entries) -> None:
        """Entries that stay at a level."""
        cell = self.cells.offsets[level] + entries.cell
        area = self.cells.sums(np.ones(self.cells.grid))[cell, 0]
        self.entries.append(Entries(cell, entries.pixel, entries.energy / area, entries.variance / area**2))

    def matrices(self, values: str = "energy") -> list[scipy.sparse.csr_array]:
        """C of each channel, or its "variance": (M, cells), all of one pattern."""
        row, column = (np.concatenate([getattr(e, name) for e in self.entries]) for name in ("pixel", "cell"))
        order = np.lexsort((column, row))
        shape = self.cells.offsets[1], self.cells.offsets[-1]
        starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=shape[0]))])
        data = np.concatenate([getattr(entries, values) for entries in self.entries], axis=1)[:, order]
        return [scipy.sparse.csr_array((channel, column[order], starts), shape=shape) for channel in data]


def most_patterns(cells: Cells) -> int:
    """Patterns that no scan goes beyond, in whole batches: every cell on its own."""
    batches = -(-np.diff(cells.offsets)[:-1] // AT_ONCE)
    return AT_ONCE * max(int(batches.sum()), 1)


def scan(pictures: Seen, log: Log, threshold: float, sigmas: float) -> Core:
    """Measure the core of T, the white picture of the calibration being its root.

    Cells are divided whose energy is above `threshold` times white, and above `sigmas` standard deviations.
    `log` may have pictures of an earlier run.
    """
    cells, white = Cells(pictures.grid), pictures.white
    core, seen = Core(cells, pictures.channels), np.flatnonzero(pictures.seen)
    value, variance = (values[:, seen].astype(np.float64) for values in white)
    active = Entries(np.zeros(len(seen), np.int64), seen, value, variance)
    least = threshold * np.maximum(white.value, 0.0)
    for level in range(len(cells.levels) - 1, 0, -1):
        bright = active.energy > least[:, active.pixel]
        clear = active.energy**2 > sigmas**2 * active.variance
        divided = np.any(bright & clear, axis=0) | (level == len(cells.levels) - 1)
        core.add(level, active.where(~divided))
        active = _divide(core, level, active.where(divided), pictures, log)
    core.add(0, active)
    # An entry of 0 where a pixel has none of its own: the diagonal is in the pattern of C.
    own = np.concatenate([entries.pixel[entries.cell == entries.pixel] for entries in core.entries])
    missing = np.setdiff1d(np.arange(cells.offsets[1]), own)
    zeros = np.zeros((core.channels, len(missing)))
    core.add(0, Entries(missing, missing, zeros, zeros))
    return core


def _divide(core: Core, level: int, parents: Entries, pictures: Seen, log: Log) -> Entries:
    """The entries of the children of all parents, by cell."""
    numbers, starts, parent = np.unique(parents.cell, return_index=True, return_inverse=True)
    colours = colour(np.append(starts, len(parent)), parents.pixel, len(pictures.seen))
    children = core.cells.children(level, numbers)
    # The only child of a cell at the rim is the cell: it was photographed as that.
    single = np.count_nonzero(children >= 0, axis=0) == 1
    groups = []  # cells that are lit together: which child, of which parents
    for number in range(int(colours.max(initial=-1)) + 1):
        for k in range(4):
            members = np.flatnonzero((colours == number) & (children[k] >= 0) & ~single)
            groups += [(k, members, children[k, members])] if len(members) else []
    energy, variance = _photograph(core, level - 1, parents, parent, groups, pictures, log)
    rest = energy.sum(axis=0) - parents.energy
    others = all_but_one(variance) + parents.variance
    total = np.maximum(variance + others, 1e-300)
    energy, variance = energy - variance / total * rest, variance / total * others
    cell, copied = children[:, parent], single[parent]
    energy[:, :, copied] = np.where(cell >= 0, 1.0, 0.0)[:, None, copied] * parents.energy[:, copied]
    variance[:, :, copied] = parents.variance[:, copied]
    k, entry = np.nonzero(cell >= 0)
    order = np.argsort(cell[k, entry], kind="stable")
    k, entry = k[order], entry[order]
    variance = np.minimum(variance[k, :, entry].T, UNKNOWN)
    return Entries(cell[k, entry], parents.pixel[entry], energy[k, :, entry].T, variance)


def _photograph(
    core: Core,
    level: int,
    parents: Entries,
    parent: np.ndarray,
    groups: list[tuple[int, np.ndarray, np.ndarray]],
    pictures: Seen,
    log: Log,
) -> tuple[np.ndarray, np.ndarray]:
    """Energy and variance (4, channels, entries) of children; `parent`: the number of that of each entry."""
    energy = np.zeros((4, *parents.energy.shape))
    variance, matrices = np.zeros_like(energy), core.matrices()
    log.announce(core.cells.pattern(level, lit) for _, _, lit in groups)
    for first in range(0, len(groups), AT_ONCE):
        batch = groups[first : first + AT_ONCE]
        patterns = [core.cells.pattern(level, lit) for _, _, lit in batch]
        for (k, members, _), pattern, picture in zip(batch, patterns, log.take(patterns), strict=True):
            entries = np.flatnonzero(np.isin(parent, members))
            pixels = parents.pixel[entries]
            sums = core.cells.sums(pattern)[:, 0]
            known = np.stack([(C @ sums)[pixels] for C in matrices])
            energy[k][:, entries] = picture.value[:, pixels] - known
            noise = picture.variance[:, pixels] + pictures.ambient[:, pixels]
            variance[k][:, entries] = noise + (_SUBTRACTED * known) ** 2
    return energy, variance


def arrays(core: Core, mixing: np.ndarray | None = None, sigmas: float = 0.0) -> dict[str, np.ndarray]:
    """The arrays of a scan as a compressed transport (`ltcl.transport`): S diag(1) with S = I + (C W - I).

    Its first bounce is 0, so that the pixel can be masked, where it is not above 0 by `sigmas` standard
    deviations. C W - I is C less 1 at every pixel's own cell.
    """
    cells, matrices, variance = core.cells, core.matrices(), core.matrices("variance")
    of = cells.of_pixels()
    own, noise = (np.stack([own_entries(A, of).sum(axis=0) for A in B]) for B in (matrices, variance))
    result: dict[str, Any] = {"grid": cells.grid, "first_bounce": first_bounce.certain(own, noise, sigmas)}
    result |= {"basis_0.name": "pyramid", "basis_0.grid": cells.grid}
    result |= {} if mixing is None else {"mixing": mixing}
    columns = np.ones(cells.offsets[1])
    for c, C in enumerate(matrices):
        values = C.data - (C.indices == np.repeat(np.arange(len(columns)), np.diff(C.indptr)))
        R = {"kind": "compressed", "error": 0.0, "out": -1, "into": 0, "diagonal": own[c] - 1.0}
        R |= {"core.kind": "csr", "core.error": 0.0, "core.shape": np.array(C.shape, np.int64)}
        R |= {"core.data": values.astype(np.float32), "core.indices": C.indices.astype(np.int32)}
        R |= {"core.indptr": C.indptr.astype(np.int64)}
        result |= {f"columns_{c}": columns, f"system_{c}.sign": 1.0, f"system_{c}.solution_error": 0.0}
        result |= {f"system_{c}.R.{name}": value for name, value in R.items()}
    return {name: np.asarray(value) for name, value in result.items()}


def variances(core: Core) -> dict[str, np.ndarray]:
    """The variance of the entries of a core, in `core_variance_0` and so on."""
    return {f"core_variance_{c}": V.data for c, V in enumerate(core.matrices("variance"))}


def stored(store: BlockStore, c: int) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
    """C of a channel, (M, cells), and the variance of its entries, from a store with `arrays`."""
    names = [f"system_{c}.R.core.{name}" for name in ("data", "indices", "indptr")]
    data, indices, indptr = (np.array(store.extra(name)) for name in names)
    shape = (len(indptr) - 1, Cells(store.layout.grid).offsets[-1])
    data[indices == np.repeat(np.arange(shape[0]), np.diff(indptr))] += 1.0  # R = C W - I
    variance = np.array(store.extra(f"core_variance_{c}"))
    C, V = (scipy.sparse.csr_array((x, indices, indptr), shape=shape) for x in (data, variance))
    return C, V


def own_entries(C: scipy.sparse.csr_array, cells: np.ndarray) -> np.ndarray:
    """(levels, rows) entries of each row of C at its `cells` (levels, rows); of all levels: diag(C W)."""
    values: list[Any] = [C[np.arange(len(columns)), columns] for columns in cells]  # sparse in SciPy 1.13
    return np.stack([(v.toarray() if scipy.sparse.issparse(v) else v).ravel() for v in values])


def colour(starts: np.ndarray, pixels: np.ndarray, count: int) -> np.ndarray:
    """Colours (n,) from 0 of n cells: no camera pixel is active in two of one colour (Sen et al. 2005).

    Greedy, the cells with most active pixels first, each into the first colour that is free. Cell k is active
    at the camera pixels ``pixels[starts[k]:starts[k + 1]]``, of `count`. Cells 0 and 1 share pixel 2, cells 1
    and 2 pixel 0:

    >>> colour(np.array([0, 1, 3, 4]), np.array([2, 2, 0, 0]), 3).tolist()
    [1, 0, 1]
    """
    colours, used = np.zeros(len(starts) - 1, np.int64), np.full(count, 0, object)  # a bit for each colour
    for cell in np.argsort(-np.diff(starts), kind="stable"):
        own = pixels[starts[cell] : starts[cell + 1]]
        bits = np.bitwise_or.reduce(used[own], initial=0)
        colours[cell] = (~bits & (bits + 1)).bit_length() - 1
        used[own] |= 1 << int(colours[cell])
    return colours
