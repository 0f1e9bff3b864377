# SPDX-License-Identifier: BSD-3-Clause
"""Hierarchical scanning with cells lit in parallel, after Sen et al. 2005 (dual photography).

The projector is one cell, then four, and so on (`Cells`). A camera pixel that sees much of a cell asks for
its four children; what it sees little of stays where it is, spread evenly over the cell: it is kept, never
dropped, so that row sums are those of white. T = C W with W the sums over cells (`ltcl.operators.Pyramid`).

Cells at which no camera pixel is active twice are lit together (`colouring`), a child of each at a time. The
picture also holds what camera pixels see a little of in the other lit cells. That is known, and subtracted:
C as far as it is found, times W times the pattern. Then the four children e_k must add up to the parent e:

    e_k - v_k r / V,    r = sum_k e_k - e,    V = sum_k v_k + v

of variances v, into which goes a part of what was subtracted.

Known limit: light that stays at a cell is smooth there. `threshold` is how much of what a camera pixel sees
under white may be; details below it are lost, sums are not.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning.cells import Cells, colour
from ltcl.acquisition.scanning.codes import all_but_one
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture, Seen

AT_ONCE = 16  # patterns of a batch
_TRUST = 0.1  # relative error of what is subtracted for cells that are lit beside


class Source(Protocol):
    """Where pictures come from, in the order in which they are asked for: `Log`."""

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """All patterns (h, w) of a level, before the first is asked for."""
        ...

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """The pictures of the next patterns, `AT_ONCE` at most."""
        ...


class Entries(NamedTuple):
    """Light of cells at camera pixels: sorted by cell, (entries,); energy and variance (channels, entries).

    Energy is that of all pixels of the cell together.
    """

    cell: np.ndarray
    pixel: np.ndarray
    energy: np.ndarray
    variance: np.ndarray

    def where(self, chosen: np.ndarray) -> Entries:
        """Some of them."""
        return Entries(
            self.cell[chosen], self.pixel[chosen], self.energy[:, chosen], self.variance[:, chosen]
        )


class Level(NamedTuple):
    """What there is to tell of a level: cells with active pixels, their entries, colours, photographs."""

    level: int
    cells: int
    entries: int
    colours: int
    patterns: int


@dataclass(eq=False)
class Core:
    """C as it is found: values for one pixel of a cell, by camera pixel and cell."""

    cells: Cells
    channels: int
    parts: list[Entries] = field(default_factory=list)

    def add(self, level: int, entries: Entries) -> None:
        """Entries that stay at a level."""
        area = self.cells.areas(level)[entries.cell]
        self.parts.append(
            Entries(
                self.cells.offsets[level] + entries.cell,
                entries.pixel,
                entries.energy / area,
                entries.variance / area**2,
            )
        )

    def complete(self) -> None:
        """Add an entry of 0 where a pixel has none of its own: the diagonal is in the pattern."""
        there = [part.pixel[part.cell == part.pixel] for part in self.parts]
        missing = np.setdiff1d(np.arange(self.cells.grid[0] * self.cells.grid[1]), np.concatenate(there))
        none = np.zeros((self.channels, len(missing)))
        self.parts.append(Entries(missing, missing, none, none))

    def matrices(self, what: str = "energy") -> list[scipy.sparse.csr_array]:
        """C of each channel, or its variance: (M, cells), all of one pattern."""
        row, column = (np.concatenate([getattr(p, k) for p in self.parts]) for k in ("pixel", "cell"))
        values = np.concatenate([getattr(part, what) for part in self.parts], axis=1)
        shape = (self.cells.grid[0] * self.cells.grid[1], self.cells.offsets[-1])
        order = np.lexsort((column, row))
        starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=shape[0]))])
        return [scipy.sparse.csr_array((part[order], column[order], starts), shape=shape) for part in values]


@dataclass(frozen=True, eq=False)
class Scan:
    """What came of it: the core, and each level."""

    core: Core
    levels: list[Level]


def most_patterns(cells: Cells) -> int:
    """Patterns that no scan goes beyond, in whole batches: every cell on its own."""
    whole = [-(-rows * columns // AT_ONCE) * AT_ONCE for rows, columns in cells.sizes[:-1]]
    return max(sum(whole), AT_ONCE)


def scan(pictures: Seen, source: Source, threshold: float, sigmas: float) -> Scan:
    """Find the core of T, the white picture of the calibration being its root.

    Parameters
    ----------
    source : Source
        May have pictures from an earlier run.
    threshold : float
        Part of what a camera pixel sees under white, that a cell is divided for.
    sigmas : float
        Standard deviations that it has to be above 0 as well.
    """
    cells, white = Cells(pictures.grid), pictures.white
    seen = np.flatnonzero(pictures.seen)
    root = Entries(
        np.zeros(len(seen), np.int64),
        seen,
        white.value[:, seen].astype(np.float64),
        white.variance[:, seen].astype(np.float64),
    )
    found, levels, active = Core(cells, pictures.channels), [], root
    least = threshold * np.maximum(white.value, 0.0)
    for level in range(cells.top, 0, -1):
        divided = _much(active, least, sigmas) if level < cells.top else np.ones(len(seen), bool)
        found.add(level, active.where(~divided))
        told, active = _divide(found, level, active.where(divided), pictures, source)
        levels.append(told)
    found.add(0, active)
    return Scan(found, levels)


def _much(entries: Entries, least: np.ndarray, sigmas: float) -> np.ndarray:
    """Entries, in any channel, above the threshold and above the noise."""
    enough = entries.energy > least[:, entries.pixel]
    return np.any(enough & (entries.energy**2 > sigmas**2 * entries.variance), axis=0)


def _divide(
    found: Core, level: int, parents: Entries, pictures: Seen, source: Source
) -> tuple[Level, Entries]:
    """The entries of the children of all parents, by cell."""
    numbers, starts, place = np.unique(parents.cell, return_index=True, return_inverse=True)
    colours = colour(np.append(starts, len(place)), parents.pixel, len(pictures.seen))
    kids = found.cells.children(level, numbers)
    # The only child of a cell at the rim is the cell: it was photographed as that.
    only = np.count_nonzero(kids >= 0, axis=0) == 1
    groups = list(_groups(kids, np.where(only, -1, colours)))
    energy, variance = _measured(found, level, parents, place, kids, groups, pictures, source)
    own = kids[:, place]
    copied = only[place]
    energy, variance = _balanced(energy, variance, parents)
    energy[:, :, copied] = np.where(own >= 0, 1.0, 0.0)[:, None, copied] * parents.energy[:, copied]
    variance[:, :, copied] = parents.variance[:, copied]
    told = Level(level, len(numbers), len(place), int(colours.max(initial=-1)) + 1, len(groups))
    return told, _children(own, parents.pixel, energy, variance)


def _measured(
    found: Core,
    level: int,
    parents: Entries,
    place: np.ndarray,
    kids: np.ndarray,
    groups: list[tuple[int, np.ndarray]],
    pictures: Seen,
    source: Source,
) -> tuple[np.ndarray, np.ndarray]:
    """Energy and variance (4, channels, entries) of children; `place`: the parent of each entry."""
    energy = np.zeros((4, *parents.energy.shape))
    variance = np.zeros_like(energy)
    stored = found.matrices() if found.parts else []
    source.announce(found.cells.pattern(level - 1, kids[k, members]) for k, members in groups)
    for first in range(0, len(groups), AT_ONCE):
        batch = groups[first : first + AT_ONCE]
        patterns = [found.cells.pattern(level - 1, kids[k, members]) for k, members in batch]
        for (k, members), pattern, picture in zip(batch, patterns, source.take(patterns), strict=True):
            here = np.flatnonzero(np.isin(place, members))
            pixels = parents.pixel[here]
            energy[k][:, here], variance[k][:, here] = _own(picture, pattern, stored, pixels, found, pictures)
    return energy, variance


def _groups(kids: np.ndarray, colours: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """(which child, of which parents) to be lit at once; none of the colour -1."""
    for number in range(int(colours.max(initial=-1)) + 1):
        for k in range(4):
            members = np.flatnonzero((colours == number) & (kids[k] >= 0))
            if len(members):
                yield k, members


def _own(
    picture: Picture,
    pattern: np.ndarray,
    stored: list[scipy.sparse.csr_array],
    pixels: np.ndarray,
    found: Core,
    pictures: Seen,
) -> tuple[np.ndarray, np.ndarray]:
    """Of a picture, at the pixels that are active, the light of the cell that each is active in."""
    beside = np.zeros((found.channels, len(pixels)))
    if stored:
        sums = found.cells.sums(pattern)
        beside = np.stack([(C @ sums)[pixels] for C in stored])
    variance = picture.variance[:, pixels] + pictures.ambient[:, pixels] + (_TRUST * beside) ** 2
    return picture.value[:, pixels] - beside, variance


def _balanced(energy: np.ndarray, variance: np.ndarray, parents: Entries) -> tuple[np.ndarray, np.ndarray]:
    """Children that add up to their parent, as far as the noise of either says."""
    rest = energy.sum(axis=0) - parents.energy
    others = all_but_one(variance) + parents.variance
    total = np.maximum(variance + others, 1e-300)
    return energy - variance / total * rest, variance / total * others


def _children(kids: np.ndarray, pixel: np.ndarray, energy: np.ndarray, variance: np.ndarray) -> Entries:
    """(4, entries) children as entries, sorted by cell."""
    k, entry = np.nonzero(kids >= 0)
    cell = kids[k, entry]
    order = np.argsort(cell, kind="stable")
    k, entry, cell = k[order], entry[order], cell[order]
    variance = np.minimum(variance[k, :, entry].T, UNKNOWN)
    return Entries(cell, pixel[entry], energy[k, :, entry].T, variance)
