# SPDX-License-Identifier: BSD-3-Clause
"""Scans by cells: light flat in cells is exact, sums always are, and few patterns suffice."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.scanning import adaptive
from ltcl.acquisition.scanning.adaptive import Cells
from ltcl.acquisition.scanning.pictures import Picture

random = np.random.default_rng(0)
GRIDS = [(1, 1), (1, 6), (7, 1), (4, 4), (5, 7), (8, 8)]


class KnownScene:
    """Grid and picture log of a known T (channels, M, N), with one standard deviation."""

    def __init__(self, T: np.ndarray, grid: tuple[int, int], sigma: float = 1e-9) -> None:
        self.T = T
        self.grid = grid
        self.channels = len(T)
        self.sigma = sigma
        self.seen = np.ones(T.shape[1], bool)
        self.ambient = np.zeros(T.shape[:2])
        self.white = self.picture(np.ones(grid))
        self.photographed: list[np.ndarray] = []
        self.announced: list[np.ndarray] = []

    def picture(self, pattern: np.ndarray) -> Picture:
        value = self.T @ pattern.ravel()
        return Picture(value, np.full_like(value, self.sigma**2))

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        self.announced = [np.array(pattern) for pattern in patterns]

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        for pattern in patterns:
            np.testing.assert_array_equal(self.announced.pop(0), pattern)
        self.photographed += patterns
        return [self.picture(pattern) for pattern in patterns]


def scan(known: Any, threshold: float = 0.004) -> adaptive.Core:
    return adaptive.scan(known, known, threshold, 3.0)


def dense(core: adaptive.Core) -> np.ndarray:
    """T of a core, (channels, M, N)."""
    W = core.cells.W.toarray()
    return np.stack([C @ W for C in core.matrices()])


def flat_in_cells(grid: tuple[int, int], channels: int) -> np.ndarray:
    """A T with strong diagonal, whose rows are flat in every cell that their pixel is not in."""
    n = grid[0] * grid[1]
    T = np.tile(np.eye(n), (channels, 1, 1))
    # Cells of each pixel by level, the finest first.
    levels = Cells(grid).W.T.tocsr().indices.reshape(n, -1).T
    for i in range(n):
        for finer, coarser in pairwise(levels):
            is_sibling = (coarser == coarser[i]) & (finer != finer[i])
            for cell in np.unique(finer[is_sibling]):
                pixels = finer == cell
                T[:, i, pixels] = 0.01 * random.random((channels, 1)) / np.sum(pixels)
    return T


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("grid", GRIDS)
def test_light_that_is_flat_in_cells_is_measured_exactly(
    grid: tuple[int, int], channels: int
) -> None:
    T = flat_in_cells(grid, channels)
    np.testing.assert_allclose(dense(scan(KnownScene(T, grid))), T, atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_tiny_threshold_measures_every_entry_by_patterns_that_differ(
    grid: tuple[int, int],
) -> None:
    """The noise of a virtual rig is the same in a run that was stopped, as patterns differ."""
    n = grid[0] * grid[1]
    known = KnownScene(0.1 + random.random((1, n, n)), grid)
    np.testing.assert_allclose(dense(scan(known, threshold=1e-6)), known.T, rtol=1e-6)
    white = np.ones(grid, np.float32)
    distinct = {pattern.tobytes() for pattern in [white, *known.photographed]}
    assert len(distinct) == 1 + len(known.photographed)
    assert len(known.photographed) <= adaptive.most_patterns(Cells(grid))


@pytest.mark.parametrize("threshold", [0.001, 0.02, 0.3])
def test_no_light_is_lost_with_any_threshold(threshold: float) -> None:
    """Light of other lit cells, which is subtracted with an error of 10 %, makes sums inexact."""
    T = random.random((1, 64, 64)) ** 4 + 3 * np.eye(64)
    sums = dense(scan(KnownScene(T, (8, 8)), threshold)).sum(axis=2)
    expected = T.sum(axis=2)
    assert np.linalg.norm(sums - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.parametrize(("first_row", "patterns"), [(0.0, 16), (1.0, 4 + 16 + 64 + 256)])
def test_cells_at_which_no_pixel_is_active_twice_are_lit_together(
    first_row: float, patterns: int
) -> None:
    """Pixels that see only themselves take four patterns a level; one that sees all, every cell."""
    T = np.eye(256)
    T[0, 1:] = first_row
    known = KnownScene(T[None], (16, 16))
    np.testing.assert_allclose(dense(scan(known, threshold=1e-3))[0], T, atol=1e-6)
    assert len(known.photographed) == patterns


def rough_scan(grid: tuple[int, int], channels: int) -> adaptive.Core:
    """The core of a scan with a large threshold."""
    n = grid[0] * grid[1]
    T = flat_in_cells(grid, channels) + 0.02 * random.random((channels, n, n))
    return scan(KnownScene(T, grid), threshold=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("grid", [(1, 7), (5, 7), (8, 8)])
def test_the_core_as_a_transport(device: Any, grid: tuple[int, int]) -> None:
    n = grid[0] * grid[1]
    core = rough_scan(grid, 1)
    [C] = dense(core)
    T = ltcl.Transport.from_arrays(adaptive.transport_arrays(core), device=device)
    np.testing.assert_allclose(T.first_bounce, np.diagonal(C), rtol=1e-6)
    x = random.random(n)
    picture = np.asarray(T @ x.reshape(grid))
    np.testing.assert_allclose(picture.ravel(), C @ x, rtol=1e-4)
    inverse = ltcl.invert(T, 1e-2, basis=("db2", "pixels"))
    B = np.eye(n) - inverse.systems[0].R.to_dense()
    residual = np.eye(n) - B @ (C / T.first_bounce)
    assert np.linalg.norm(residual, 2) <= inverse.error <= 1e-2


def test_the_core_as_a_transport_in_colours(device: Any) -> None:
    grid = (5, 7)
    core = rough_scan(grid, 3)
    C = dense(core)
    mixing = np.eye(3) + 0.1
    T = ltcl.Transport.from_arrays(adaptive.transport_arrays(core, mixing), device=device)
    np.testing.assert_allclose(T.first_bounce, np.diagonal(C, axis1=1, axis2=2), rtol=1e-6)
    x = random.random((*grid, 3))
    expected = np.einsum("cij,cd,jd->ic", C, mixing, x.reshape(-1, 3))
    picture = np.asarray(T @ x)
    np.testing.assert_allclose(picture.reshape(-1, 3), expected, rtol=1e-4)


def test_variance_of_light_that_stays_at_a_cell() -> None:
    """Four children and a parent of variance v: 4 v / 5 of each sum, over 4 pixels squared."""
    v = 1e-4
    core = scan(KnownScene(np.ones((1, 16, 16)), (4, 4), v**0.5), threshold=0.9)
    _, start, stop, *_ = core.cells.offsets
    [variances] = core.variances()
    level = variances[:, start:stop].toarray()
    np.testing.assert_allclose(level, np.full((16, 4), 0.8 * v / 4**2))
