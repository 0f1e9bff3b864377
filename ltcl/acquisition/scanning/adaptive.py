# SPDX-License-Identifier: BSD-3-Clause
"""Hierarchical scanning with cells lit in parallel, after Sen et al. 2005 (dual photography).

The projector is one cell, then four, and so on (`Cells`). A camera pixel that sees more of a cell
under white than `threshold` asks for its four children; the light of other cells stays where it is,
spread evenly over the cell, so that row sums are those of white: T = C W with W the sums over cells
(`ltcl.operators.Pyramid`).

Cells at which no camera pixel is active twice are lit together (`colour`), a child of each at a
time. What camera pixels see of the other lit cells is known, and subtracted: C so far, times W
times the pattern. Then the four children e_k, of variances v_k, must add up to the parent e, of
variance v:

    e_k - v_k r / V,    r = sum_k e_k - e,    V = sum_k v_k + v

Known limit: light that stays at a cell is smooth there; details below the threshold are lost, sums
are not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.scanning.columns import all_but_one
from ltcl.acquisition.scanning.pictures import UNKNOWN, Log, Seen
from ltcl.transport import first_bounce

AT_ONCE = 16  # patterns of a batch
_SUBTRACTED = 0.1  # relative error of what is subtracted for other lit cells


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
        side = max(self.grid)
        count = (side - 1).bit_length() + 1
        return tuple(Blocks(self.grid, min(1 << level, side)) for level in range(count))

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """The number of the first cell of each level; and of all cells at the end."""
        return (0, *np.cumsum([level.grid[0] * level.grid[1] for level in self.levels]).tolist())

    @cached_property
    def W(self) -> scipy.sparse.csr_array:
        """Sums over the cells of all levels, (cells, N) float64."""
        numbers = np.split(np.arange(self.offsets[-1]), self.offsets[1:-1])
        cells = [
            b.enlarged(level.reshape(b.grid)) for b, level in zip(self.levels, numbers, strict=True)
        ]
        pixels = np.tile(np.arange(self.offsets[1]), len(cells))
        return scipy.sparse.csr_array((np.ones(len(pixels)), (np.ravel(cells), pixels)))

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
        return Entries(*(values[..., mask] for values in self))


class Core(NamedTuple):
    """C as far as it is measured: the light of one pixel of a cell, by camera pixel and cell."""

    cells: Cells
    entries: list[Entries]

    def add(self, level: int, entries: Entries) -> None:
        """Entries that stay at a level."""
        cell = self.cells.offsets[level] + entries.cell
        area = self.cells.W.sum(axis=1)[cell]
        self.entries.append(
            Entries(cell, entries.pixel, entries.energy / area, entries.variance / area**2)
        )

    def matrices(self, values: str = "energy") -> list[scipy.sparse.csr_array]:
        """C of each channel, or its "variance": (M, cells), all of one pattern."""
        row, column = (
            np.concatenate([getattr(e, name) for e in self.entries]) for name in ("pixel", "cell")
        )
        data = np.concatenate([getattr(entries, values) for entries in self.entries], axis=1)
        return [
            scipy.sparse.csr_array((x, (row, column)), shape=self.cells.W.T.shape) for x in data
        ]

    def variances(self, channel: int) -> Iterator[tuple[np.ndarray, ...]]:
        """Rows, columns, light, and variances of pixels whose sums over cells are right."""
        C, V = self.matrices()[channel], self.matrices("variance")[channel]
        area, v = np.asarray(self.cells.W.sum(axis=1)), np.asarray(V.data)
        V.data = np.where(v < 1e-3 * UNKNOWN, v * area[V.indices], 0.0)
        for start in range(0, self.cells.offsets[1], AT_ONCE):
            light, variance = (
                (A[start : start + AT_ONCE] @ self.cells.W).toarray() for A in (C, V)
            )
            i, j = np.nonzero(variance)
            yield i + start, j, light[i, j], variance[i, j]


def most_patterns(cells: Cells) -> int:
    """Patterns that no scan goes beyond, in whole batches: every cell on its own."""
    batches = -(-np.diff(cells.offsets)[:-1] // AT_ONCE)
    return AT_ONCE * max(int(batches.sum()), 1)


def scan(pictures: Seen, log: Log, threshold: float, sigmas: float) -> Core:
    """Measure the core of T, the white picture of the calibration being its root.

    Cells are divided whose energy is above `threshold` times white, and above `sigmas` standard
    deviations. `log` may have pictures of an earlier run.
    """
    cells, white = Cells(pictures.grid), pictures.white
    pixels, seen = np.arange(len(pictures.seen)), np.flatnonzero(pictures.seen)
    zeros = np.zeros((pictures.channels, len(pixels)))
    core = Core(
        cells, [Entries(pixels, pixels, zeros, zeros)]
    )  # the diagonal is in the pattern of C
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
    return core


def _divide(core: Core, level: int, parents: Entries, pictures: Seen, log: Log) -> Entries:
    """The entries of the children of all parents, by cell."""
    cells, matrices = core.cells, core.matrices()
    numbers, starts, parent = np.unique(parents.cell, return_index=True, return_inverse=True)
    children = cells.children(level, numbers)
    # The only child of a cell at the rim is the cell: it was photographed as that.
    single = np.count_nonzero(children >= 0, axis=0) == 1
    colours = np.where(
        single, -1, colour(np.append(starts, len(parent)), parents.pixel, len(pictures.seen))
    )
    groups = []  # cells that are lit together: which child, of which parents
    for number in range(int(colours.max(initial=-1)) + 1):
        for k in range(4):
            members = np.flatnonzero((colours == number) & (children[k] >= 0))
            groups += [(k, members)] if len(members) else []
    log.announce(cells.pattern(level - 1, children[k, members]) for k, members in groups)
    cell = children[:, parent]
    energy = np.zeros((4, *parents.energy.shape))
    variance = energy + np.where(cell >= 0, UNKNOWN, 0.0)[:, None]  # where no photograph follows
    for first in range(0, len(groups), AT_ONCE):
        batch = groups[first : first + AT_ONCE]
        patterns = [cells.pattern(level - 1, children[k, members]) for k, members in batch]
        for (k, members), pattern, picture in zip(batch, patterns, log.take(patterns), strict=True):
            entries = np.flatnonzero(np.isin(parent, members))
            pixels, sums = parents.pixel[entries], cells.W @ pattern.ravel()
            known = np.stack([(C @ sums)[pixels] for C in matrices])
            energy[k][:, entries] = picture.value[:, pixels] - known
            noise = picture.variance[:, pixels] + pictures.ambient[:, pixels]
            variance[k][:, entries] = noise + (_SUBTRACTED * known) ** 2
    others = all_but_one(variance) + parents.variance
    total = np.maximum(variance + others, 1e-300)
    energy -= variance / total * (energy.sum(axis=0) - parents.energy)
    variance *= others / total
    k, entry = np.nonzero(cell >= 0)
    order = np.argsort(cell[k, entry], kind="stable")
    k, entry = k[order], entry[order]
    return Entries(
        cell[k, entry], parents.pixel[entry], energy[k, :, entry].T, variance[k, :, entry].T
    )


def arrays(
    core: Core, mixing: np.ndarray | None = None, sigmas: float = 0.0
) -> dict[str, np.ndarray]:
    """The arrays of a scan as a compressed transport (`ltcl.transport`): S diag(1) with S = I + (C W - I).

    Its first bounce is 0, so that the pixel can be masked, where it is not above 0 by `sigmas`
    standard deviations. C W - I is C less 1 at every pixel's own cell.
    """
    cells, matrices, variance = core.cells, core.matrices(), core.matrices("variance")
    own, noise = (
        np.stack([A.multiply(cells.W.T).sum(axis=1) for A in B]) for B in (matrices, variance)
    )
    result: dict[str, Any] = {
        "grid": cells.grid,
        "first_bounce": first_bounce.drop_uncertain(own, noise, sigmas),
    }
    result |= {"basis_0.name": "pyramid", "basis_0.grid": cells.grid}
    result |= {} if mixing is None else {"mixing": mixing}
    columns = np.ones(cells.offsets[1])
    for c, C in enumerate(matrices):
        values = C.data - (C.indices == np.repeat(np.arange(len(columns)), np.diff(C.indptr)))
        R = {"kind": "compressed", "error": 0.0, "out": -1, "into": 0, "diagonal": own[c] - 1.0}
        R |= {"core.kind": "csr", "core.error": 0.0, "core.shape": np.array(C.shape, np.int64)}
        R |= {"core.data": values.astype(np.float32), "core.indices": C.indices.astype(np.int32)}
        R |= {"core.indptr": C.indptr.astype(np.int64)}
        result |= {
            f"columns_{c}": columns,
            f"system_{c}.sign": 1.0,
            f"system_{c}.solution_error": 0.0,
        }
        result |= {f"system_{c}.R.{name}": value for name, value in R.items()}
    return {name: np.asarray(value) for name, value in result.items()}


def colour(starts: np.ndarray, pixels: np.ndarray, count: int) -> np.ndarray:
    """Colours (n,) from 0 of n cells: no camera pixel is active in two of one colour (Sen et al. 2005).

    Greedy, the cells with most active pixels first, each into the first colour that is free. Cell k
    is active at the camera pixels ``pixels[starts[k]:starts[k + 1]]``, of `count`.
    """
    colours, used = (
        np.zeros(len(starts) - 1, np.int64),
        np.full(count, 0, object),
    )  # a bit for each colour
    for cell in np.argsort(-np.diff(starts), kind="stable"):
        own = pixels[starts[cell] : starts[cell + 1]]
        bits = np.bitwise_or.reduce(used[own], initial=0)
        colours[cell] = (~bits & (bits + 1)).bit_length() - 1
        used[own] |= 1 << int(colours[cell])
    return colours
