# SPDX-License-Identifier: BSD-3-Clause
"""T of a finished scan on the host, and the same after the projector has moved.

A scan is T = C W: rows of T in functions h_n, whose sums W are (`ltcl.operators.Hats`), or in
pixels. The row of a new pixel i is that of its old place g(i), read at the old places of the
columns,

    T'[i, j] = gain f_g(i)(g(j)),    f_a(u) = sum_n C_a,n h_n(u)

which keeps the light: a pixel of the projector sends the same wherever it falls. Two parts go two
ways:

    direct   the diagonal, and around it, up to `REACH` pixels, what a pixel that is out of focus
             lights: entries stay as far from the diagonal, since new pixel j lights the place that
             new pixel j looks at, however it falls on the old pixels
    others   rows are interpolated between the old ones, and functions of each level between its
             nodes: C' = B C P, with P_n,m = h_n(g(m)) at the nodes m; what the nodes of the next
             finer level show beyond that, as at a crease, is added there

An entry k pixels from the diagonal holds both. Focus is the same all around, and light that bounced
between neighbours is not: it crosses a crease, in a line of pixels. So the direct part is, of the
pixel's own light, the median share of the entries k pixels from the diagonal nearby, beyond what
the camera's pixels explain (`focus`).

Places beyond the old picture have no known row; their columns go on as at its rim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its subpackage ndimage is loaded at the first use
import scipy.sparse

from ltcl.acquisition.estimation.estimator import BASIS
from ltcl.acquisition.estimation.windows import REACH, hat_levels, hat_matrix
from ltcl.acquisition.scanning.adaptive import Cells
from ltcl.acquisition.updating.focus import (
    LEAST_LIGHT,
    MIDDLE,
    WINDOW,
    Focus,
    near_diagonal,
)
from ltcl.acquisition.updating.movement import Movement, interpolation
from ltcl.errors import FileError
from ltcl.store import BlockStore
from ltcl.store.block_store import read

# Light of a coefficient that is left out, relative to that of its row.
NEGLIGIBLE_LIGHT = 1e-6
# Light of a function of the next finer level that corrects one that was read between its nodes,
# relative to that of its row, below which it is left out: a third of these functions stay, and none
# that pictures would show (with 3e-4 errors grow by a hundredth, with 1e-3 by a tenth).
NOTABLE_LIGHT = 1e-4
# Side of the square of pixels over which focus is the same.
FOCUS_SIDE = 7


@dataclass(frozen=True, eq=False, kw_only=True)
class HostTransport:
    """T = C W of each channel in hats on a grid.

    Attributes
    ----------
    grid : (h, w)
    cores : sequence of (N, nodes) csr_array
        C of each channel.
    W : (nodes, N) csr_array
        The hats of all levels on the pixels; level 0 is the pixels.
    """

    grid: tuple[int, int]
    cores: Sequence[Any]
    W: Any

    @classmethod
    def of(cls, store: BlockStore) -> HostTransport:
        """T of a finished scan: a sketch, in hats, or another one, in pixels."""
        record: Any = read(store.path)
        grid = store.layout.grid
        if grid is None:
            raise FileError(f"{store.path}: does not say how its pixels lie side by side")
        W: Any = hat_matrix(grid)
        nodes = W.shape[0]
        cores = []
        for channel in range(store.layout.channels):
            if store.layout.kind != "compressed":
                cores.append(_in_pixels(record.matrices[channel].tocsr(), nodes))
                continue
            core: Any = _compressed_core(record.arrays, channel, W)
            core = core + scipy.sparse.eye_array(*core.shape, format="csr")
            if str(record.arrays["basis_0.name"]) != BASIS:
                core = _in_pixels(core @ Cells(grid).W, nodes)
            cores.append(core)
        return cls(grid=grid, cores=cores, W=W)

    def products(self, patterns: np.ndarray) -> np.ndarray:
        """T p of patterns (k, N), (k, N, channels)."""
        sums = self.W @ np.asarray(patterns, np.float64).T
        return np.stack([(core @ sums).T for core in self.cores], axis=2)

    def scaled(self, gain: np.ndarray) -> HostTransport:
        """The transport of light that is brighter by the gains (channels,)."""
        cores = [factor * core for factor, core in zip(gain, self.cores, strict=True)]
        return HostTransport(grid=self.grid, cores=cores, W=self.W)

    def limited(self, known: np.ndarray) -> HostTransport:
        """The transport with empty rows but of the pixels `known`, (N,)."""
        rows = scipy.sparse.diags_array(known.astype(np.float64))
        cores = [scipy.sparse.csr_array(rows @ core) for core in self.cores]
        for core in cores:
            core.eliminate_zeros()
        return HostTransport(grid=self.grid, cores=cores, W=self.W)

    def around_diagonal(self) -> np.ndarray:
        """Light of pixels up to `REACH` from each, of all channels, (N, 25)."""
        pixels = self.cores[0].shape[0]
        near = [near_diagonal(core[:, :pixels].tocoo(), self.grid) for core in self.cores]
        return np.sum(near, axis=0)

    def moved(self, movement: Movement, focus: Focus | None = None) -> HostTransport:
        """The transport after the projector has moved; rows of unknown places are empty."""
        warp = _Warp(movement, focus)
        return HostTransport(grid=self.grid, cores=[warp.core(C) for C in self.cores], W=self.W)


def _in_pixels(T: Any, nodes: int) -> scipy.sparse.csr_array:
    """C of T (N, N): pixels are the first of the nodes."""
    matrix: Any = scipy.sparse.csr_array(T)
    entries = matrix.data.astype(np.float64), matrix.indices, matrix.indptr
    return scipy.sparse.csr_array(entries, shape=(matrix.shape[0], nodes))


def _compressed_core(arrays: Any, channel: int, W: Any) -> scipy.sparse.csr_array:
    """C - I of a channel, in hats or cells; in a sketch of many pixels C is diag(scale) W^T K."""
    core = f"system_{channel}.R.core."
    entries = (
        np.asarray(arrays[f"{core}data"], np.float64),
        arrays[f"{core}indices"],
        arrays[f"{core}indptr"],
    )
    C: Any = scipy.sparse.csr_array(entries, shape=tuple(arrays[f"{core}shape"].tolist()))
    out = int(arrays[f"system_{channel}.R.out"])
    if out >= 0:
        C = np.asarray(arrays[f"basis_{out}.scale"])[:, None] * (W.T @ C)
    return scipy.sparse.csr_array(C)


def known_pixels(movement: Movement) -> np.ndarray:
    """New pixels (N,) whose old places lie on the old picture."""
    height, width = movement.grid
    row, column = movement.backward(*np.indices(movement.grid).reshape(2, -1))
    is_in_rows = (row > -0.5) & (row < height - 0.5)
    return is_in_rows & (column > -0.5) & (column < width - 0.5)


def row_interpolation(movement: Movement) -> scipy.sparse.csr_array:
    """B (N, N): pictures on the old pixels at the places of new ones; empty where unknown."""
    places = movement.backward(*np.indices(movement.grid).reshape(2, -1))
    B = interpolation(*places, movement.grid, to_rim=True)
    known = known_pixels(movement).astype(np.float64)
    return scipy.sparse.csr_array(known[:, None] * B)


class _Warp:
    """The parts of C' = B C P for a movement."""

    def __init__(self, movement: Movement, focus: Focus | None) -> None:
        self.grid = movement.grid
        self.focus = focus
        self.movement = movement
        self.rows = row_interpolation(movement)
        self.levels = hat_levels(movement.grid)

    def core(self, C: Any) -> scipy.sparse.csr_array:
        """C' of a channel."""
        light = _row_light(self.rows @ C, self.levels)
        cores: list[Any] = []
        first = 0
        for level, (height, width) in enumerate(self.levels):
            count = height * width
            level_core = scipy.sparse.csr_array(C[:, first : first + count])
            first += count
            if level == 0:
                near, far = self._split(level_core)
                if far.nnz:
                    near = near + self.rows @ far @ self._read_at(0, 0)
                cores.append(near)
                continue
            rows = self.rows @ level_core
            nodes = self._read_at(level, level)
            cores.append(rows @ nodes)
            # What the finer nodes between show beyond that, as at a crease.
            finer = level - 1
            missed = self._read_at(level, finer) - nodes @ _between(self.levels, level)
            correction = _notable(rows @ missed, NOTABLE_LIGHT * light / 4.0**finer)
            cores[finer] = cores[finer] + correction
        return without_negligible(scipy.sparse.csr_array(scipy.sparse.hstack(cores)))

    def _read_at(self, level: int, nodes: int) -> scipy.sparse.csr_array:
        """Hats of a level at the old places of the nodes of a level, (nodes of both)."""
        size = 2.0**level
        row, column = np.indices(self.levels[nodes]).reshape(2, -1) * 2.0**nodes
        old_row, old_column = self.movement.backward(row, column)
        places = interpolation(old_row / size, old_column / size, self.levels[level], to_rim=True)
        return scipy.sparse.csr_array(places.T)

    def _split(self, level_core: Any) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """Direct light, moved along with the diagonal, and all other entries as they were."""
        width = self.grid[1]
        entries = scipy.sparse.coo_array(level_core)
        near = near_diagonal(entries, self.grid)
        down = entries.col // width - entries.row // width
        across = entries.col % width - entries.row % width
        is_far = (np.abs(down) > REACH) | (np.abs(across) > REACH)
        far = scipy.sparse.csr_array(
            (entries.data[is_far], (entries.row[is_far], entries.col[is_far])),
            shape=level_core.shape,
        )
        direct = _direct_light(near, self.grid, self.focus)
        if self.focus is None:
            moved = self.rows @ direct
        else:
            moved = self.focus.refocused(direct, self.rows)
        return self._beside_diagonal(moved), far + self._beside_diagonal(near - direct)

    def _beside_diagonal(self, near: np.ndarray) -> scipy.sparse.csr_array:
        """Entries (N, 25) of windows around the diagonal in their places, (N, N)."""
        height, width = self.grid
        i, k = np.nonzero(near)
        row = i // width + k // WINDOW - REACH
        column = i % width + k % WINDOW - REACH
        is_there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        i = i[is_there]
        k = k[is_there]
        places = i, (row * width + column)[is_there]
        return scipy.sparse.csr_array((near[i, k], places), shape=(len(near), len(near)))


def _direct_light(near: np.ndarray, grid: tuple[int, int], focus: Focus | None) -> np.ndarray:
    """The direct part of entries (N, 25) of windows around the diagonal."""
    own = near[:, MIDDLE]
    is_lit = own > 0
    if not is_lit.any():
        return near
    direct = np.zeros_like(near)
    direct[:, MIDDLE] = own
    # Shares that are known beforehand, from which those of the light differ by a median.
    expected = np.zeros_like(near)
    if focus is not None:
        expected = focus.before / np.maximum(focus.before[:, MIDDLE, None], LEAST_LIGHT)
    # What is seen nowhere has the focus of the nearest pixel that is.
    nearest = scipy.ndimage.distance_transform_edt(
        ~is_lit.reshape(grid), return_distances=False, return_indices=True
    )
    for offset in np.flatnonzero(near.any(axis=0)):
        if offset == MIDDLE:
            continue
        share = np.divide(near[:, offset], own, where=is_lit, out=np.zeros_like(own))
        others = (share - expected[:, offset]).reshape(grid)[tuple(nearest)]
        typical = scipy.ndimage.median_filter(others, FOCUS_SIDE, mode="nearest")
        direct[:, offset] = (expected[:, offset] + typical.ravel()) * own
    return direct


def without_negligible(core: Any) -> scipy.sparse.csr_array:
    """A core without coefficients that hardly count in their row."""
    matrix = scipy.sparse.csr_array(core)
    lengths = np.diff(matrix.indptr)
    largest = np.asarray(abs(matrix).max(axis=1).todense()).ravel()
    matrix.data[np.abs(matrix.data) < NEGLIGIBLE_LIGHT * np.repeat(largest, lengths)] = 0.0
    matrix.eliminate_zeros()
    matrix.sort_indices()
    return matrix


def _between(levels: Sequence[tuple[int, int]], level: int) -> Any:
    """Hats of a level at the nodes of the next finer one, (nodes of both)."""
    row, column = np.indices(levels[level - 1]).reshape(2, -1) / 2.0
    return interpolation(row, column, levels[level], to_rim=True).T


def _row_light(core: Any, levels: Sequence[tuple[int, int]]) -> np.ndarray:
    """Light of each row under white, about, (N,)."""
    areas = [np.full(height * width, 4.0**level) for level, (height, width) in enumerate(levels)]
    return abs(core) @ np.concatenate(areas)


def _notable(core: Any, least: np.ndarray) -> scipy.sparse.csr_array:
    """The coefficients of each row that are above a least one."""
    matrix = scipy.sparse.csr_array(core)
    lengths = np.diff(matrix.indptr)
    matrix.data[np.abs(matrix.data) < np.repeat(least, lengths)] = 0.0
    matrix.eliminate_zeros()
    return matrix
