# SPDX-License-Identifier: BSD-3-Clause
"""Scans by cells: what is flat in cells comes back exactly, sums always do, and few patterns are needed."""

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


class Known:
    """Pictures of a known T (channels, M, N) and their log, of one standard deviation."""

    def __init__(self, T: np.ndarray, grid: tuple[int, int], sigma: float = 1e-9) -> None:
        self.T, self.grid, self.channels, self.sigma = T, grid, len(T), sigma
        self.seen, self.ambient = np.ones(T.shape[1], bool), np.zeros(T.shape[:2])
        self.white = self.of(np.ones(grid))
        self.photographed: list[np.ndarray] = []
        self.announced: list[np.ndarray] = []

    def of(self, pattern: np.ndarray) -> Picture:
        value = self.T @ pattern.ravel()
        return Picture(value, np.full_like(value, self.sigma**2))

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        self.announced = [np.array(pattern) for pattern in patterns]

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        for pattern in patterns:
            np.testing.assert_array_equal(self.announced.pop(0), pattern)
        self.photographed += patterns
        return [self.of(pattern) for pattern in patterns]


def scan(known: Any, threshold: float = 0.004) -> adaptive.Core:
    return adaptive.scan(known, known, threshold, 3.0)


def dense(core: adaptive.Core) -> np.ndarray:
    """(channels, M, N)."""
    return np.stack([C @ core.cells.W.toarray() for C in core.matrices()])


def flat(grid: tuple[int, int], channels: int) -> np.ndarray:
    """A T whose rows are strong at their own pixel, and flat in every cell that it is not in."""
    n = grid[0] * grid[1]
    T, cells = np.tile(np.eye(n), (channels, 1, 1)), Cells(grid).W.T.tocsr().indices.reshape(n, -1)
    for i in range(n):
        for finer, coarser in pairwise(cells.T):  # of each pixel
            for cell in np.unique(finer[(coarser == coarser[i]) & (finer != finer[i])]):
                T[:, i, finer == cell] = 0.01 * random.random((channels, 1)) / np.sum(finer == cell)
    return T


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("grid", GRIDS)
def test_light_that_is_flat_in_cells_is_measured_exactly(
    grid: tuple[int, int], channels: int
) -> None:
    T = flat(grid, channels)
    np.testing.assert_allclose(dense(scan(Known(T, grid))), T, atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_threshold_of_nothing_measures_every_entry_by_patterns_that_differ(
    grid: tuple[int, int],
) -> None:
    """So that the noise of a virtual rig is the same in a run that was stopped."""
    n = grid[0] * grid[1]
    known = Known(0.1 + random.random((1, n, n)), grid)
    np.testing.assert_allclose(dense(scan(known, threshold=1e-6)), known.T, rtol=1e-6)
    patterns = {pattern.tobytes() for pattern in [np.ones(grid, np.float32), *known.photographed]}
    assert len(patterns) == 1 + len(known.photographed)
    assert len(known.photographed) <= adaptive.most_patterns(Cells(grid))


@pytest.mark.parametrize("threshold", [0.001, 0.02, 0.3])
def test_no_light_is_lost_whatever_the_threshold(threshold: float) -> None:
    T = random.random((1, 64, 64)) ** 4 + 3 * np.eye(64)
    sums = dense(scan(Known(T, (8, 8)), threshold)).sum(axis=2)
    np.testing.assert_allclose(sums, T.sum(axis=2), rtol=5e-3)


def test_cells_at_which_no_pixel_is_active_twice_are_lit_together() -> None:
    """Pixels that see themselves alone: four patterns a level. A pixel that sees everything: every cell."""
    T = np.eye(256)
    for patterns in (16, 4 + 16 + 64 + 256):
        known = Known(T[None], (16, 16))
        np.testing.assert_allclose(dense(scan(known, threshold=1e-3))[0], T, atol=1e-6)
        assert len(known.photographed) == patterns
        T[0] = 1.0


@pytest.mark.parametrize(("grid", "channels"), [((1, 7), 1), ((5, 7), 1), ((5, 7), 3), ((8, 8), 1)])
def test_the_core_as_a_transport(device: Any, grid: tuple[int, int], channels: int) -> None:
    n = grid[0] * grid[1]
    core = scan(
        Known(flat(grid, channels) + 0.02 * random.random((channels, n, n)), grid), threshold=0.03
    )
    C, mixing = dense(core), np.eye(3) + 0.1 if channels == 3 else np.eye(1)
    T = ltcl.Transport.from_arrays(
        adaptive.arrays(core, mixing if channels == 3 else None), device=device
    )
    np.testing.assert_allclose(
        np.atleast_2d(T.first_bounce), np.diagonal(C, axis1=1, axis2=2), rtol=1e-6
    )
    x = random.random((n, channels))
    expected = np.einsum("cij,cd,jd->ic", C, mixing, x)
    shown = np.asarray(T @ x.reshape(*grid, channels).squeeze())
    np.testing.assert_allclose(shown.reshape(n, -1), expected, rtol=1e-4)
    if channels == 1 and n > 1:
        inverse = ltcl.invert(T, 1e-2, basis=("db2", "pixels"))
        B = np.eye(n) - inverse.systems[0].R.to_dense()
        assert np.linalg.norm(np.eye(n) - B @ (C[0] / T.first_bounce), 2) <= inverse.error <= 1e-2


def test_variance_of_light_that_stays_at_a_cell() -> None:
    """Four children and their parent, each of variance v: 4 v / 5 of each sum, over 4 pixels squared."""
    v = 1e-4
    core = scan(Known(np.ones((1, 16, 16)), (4, 4), v**0.5), threshold=0.9)
    variance = core.matrices("variance")[0][:, slice(*core.cells.offsets[1:3])].toarray()
    np.testing.assert_allclose(variance, np.full((16, 4), 0.8 * v / 4**2))
