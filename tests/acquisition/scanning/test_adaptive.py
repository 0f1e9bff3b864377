# SPDX-License-Identifier: BSD-3-Clause
"""Scans by cells: what is flat in cells comes back exactly, sums always do, and few patterns are needed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.scanning import adaptive, core
from ltcl.acquisition.scanning.cells import Cells
from ltcl.acquisition.scanning.pictures import Picture
from ltcl.transport import from_arrays

GRIDS = [(1, 1), (1, 6), (7, 1), (4, 4), (5, 7), (8, 8)]


class Known:
    """Pictures of a known T (channels, M, N), with noise of one standard deviation where it is wanted."""

    def __init__(self, T: np.ndarray, grid: tuple[int, int], sigma: float = 1e-9) -> None:
        self.T, self.grid, self.channels, self.sigma = T, grid, len(T), sigma
        self.seen, self.ambient = np.ones(T.shape[1], bool), np.zeros(T.shape[:2])
        self.white = self.of(np.ones(grid))
        self.asked: list[np.ndarray] = []
        self.told: list[np.ndarray] = []

    def of(self, pattern: np.ndarray) -> Picture:
        value = self.T @ pattern.ravel()
        return Picture(value, np.full_like(value, self.sigma**2))

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        self.told = [np.array(pattern) for pattern in patterns]

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        for pattern in patterns:
            np.testing.assert_array_equal(self.told.pop(0), pattern)
        self.asked += patterns
        return [self.of(pattern) for pattern in patterns]


def scan(known: Known, threshold: float = 0.004) -> adaptive.Scan:
    taken: Any = known
    return adaptive.scan(taken, known, threshold, 3.0)


def dense(found: adaptive.Scan) -> np.ndarray:
    """(channels, M, N) of the core."""
    cells = found.core.cells
    levels = [cells.of_pixels(level) for level in range(cells.top + 1)]
    return np.stack([sum(C.toarray()[:, of] for of in levels) for C in found.core.matrices()])


def flat(grid: tuple[int, int], channels: int, seed: int) -> np.ndarray:
    """A T whose rows are strong at their own pixel, and flat in every cell that it is not in."""
    cells, rng = Cells(grid), np.random.default_rng(seed)
    n = grid[0] * grid[1]
    T = np.zeros((channels, n, n))
    for i in range(n):
        T[:, i, i] = 1.0
        for level in range(cells.top):
            beside = (cells.of_pixels(level + 1) == cells.of_pixels(level + 1)[i]) & (
                cells.of_pixels(level) != cells.of_pixels(level)[i]
            )
            for cell in np.unique(cells.of_pixels(level)[beside]):
                inside = cells.of_pixels(level) == cell
                T[:, i, inside] = 0.01 * rng.random((channels, 1)) / inside.sum()
    return T


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("grid", GRIDS)
def test_what_is_asked_for_comes_back(grid: tuple[int, int], channels: int) -> None:
    T = flat(grid, channels, 3)
    np.testing.assert_allclose(dense(scan(Known(T, grid))), T, atol=1e-9)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_threshold_of_nothing_measures_every_entry(grid: tuple[int, int]) -> None:
    n = grid[0] * grid[1]
    T = 0.1 + np.random.default_rng(0).random((1, n, n))
    np.testing.assert_allclose(dense(scan(Known(T, grid), threshold=1e-6)), T, rtol=1e-6)


@pytest.mark.parametrize("threshold", [0.001, 0.02, 0.3])
def test_no_light_is_lost_whatever_the_threshold(threshold: float) -> None:
    grid, rng = (8, 8), np.random.default_rng(4)
    T = rng.random((1, 64, 64)) ** 4 + 3 * np.eye(64)
    found = dense(scan(Known(T, grid), threshold))
    np.testing.assert_allclose(found.sum(axis=2), T.sum(axis=2), rtol=2e-3)


def test_a_scene_without_bounces_takes_four_patterns_a_level() -> None:
    known = Known(np.eye(256)[None], (16, 16))
    found = scan(known)
    assert [level.colours for level in found.levels] == [1, 1, 1, 1]
    assert len(known.asked) == 16
    np.testing.assert_allclose(dense(found)[0], np.eye(256), atol=1e-6)


def test_no_pattern_comes_twice() -> None:
    """So that the noise of a virtual rig is the same in a run that was stopped."""
    for grid in GRIDS:
        n = grid[0] * grid[1]
        known = Known(np.random.default_rng(1).random((1, n, n)) + 2 * np.eye(n), grid)
        scan(known)
        asked = [pattern.tobytes() for pattern in known.asked]
        assert len(set(asked)) == len(asked)
        assert np.ones(grid, np.float32).tobytes() not in asked
        assert len(asked) <= adaptive.most_patterns(Cells(grid))


@pytest.mark.parametrize("channels", [1, 3])
def test_the_core_as_a_transport(device: Any, channels: int) -> None:
    grid = (5, 7)
    T = flat(grid, channels, 5) + 0.02 * np.random.default_rng(0).random((channels, 35, 35))
    found = scan(Known(T, grid), threshold=0.03)
    C, cells = dense(found), found.core.cells
    mixing = np.eye(3) + 0.1 if channels == 3 else None
    arrays = core.arrays(found.core, mixing)
    made = from_arrays(arrays, device=device)
    np.testing.assert_allclose(np.atleast_2d(made.first_bounce), np.diagonal(C, axis1=1, axis2=2), rtol=1e-6)
    x = np.random.default_rng(2).random((*grid, 3) if channels == 3 else grid)
    light = [x.ravel()] if channels == 1 else list((x.reshape(-1, 3) @ (np.eye(3) + 0.1).T).T)
    wanted = np.stack([part @ q for part, q in zip(C, light, strict=True)], axis=-1)
    np.testing.assert_allclose(np.asarray(made @ x).reshape(35, -1), wanted, rtol=1e-4)
    (first, *_), pixels = found.core.matrices(), np.array([0, 3, 20, 34])
    np.testing.assert_allclose(core.between(cells, first, pixels), C[0][np.ix_(pixels, pixels)])
    assert core.variances(found.core)["core_variance_0"].shape == arrays["system_0.R.core.data"].shape


def test_the_core_is_inverted_from_products_with_it(device: Any) -> None:
    grid = (5, 7)
    T = flat(grid, 1, 5) + 2.0 * np.eye(35)
    found = scan(Known(T, grid), threshold=0.03)
    made = from_arrays(core.arrays(found.core), device=device)
    S = dense(found)[0] / made.first_bounce
    C = ltcl.compress(made, 0.05)
    assert np.linalg.norm(np.linalg.inv(C.systems[0].to_dense()) @ S - np.eye(35), 2) <= C.error <= 0.05
    for basis in (("db2", "pixels"), "pixels"):
        inverse = ltcl.invert(made, 1e-2, basis=basis)
        A = inverse.systems[0].R.to_dense()
        assert np.linalg.norm(np.eye(35) - (np.eye(35) - A) @ S, 2) <= inverse.error <= 1e-2


def test_variance_of_light_that_stays_at_a_cell() -> None:
    """Four children and their parent, each of variance v: 4 v / 5 of each sum, over 4 pixels squared."""
    v = 1e-4
    found = scan(Known(np.ones((1, 16, 16)), (4, 4), v**0.5), threshold=0.9)
    cells, (variance,) = found.core.cells, found.core.matrices("variance")
    level_1 = variance[:, cells.offsets[1] : cells.offsets[2]].toarray()
    np.testing.assert_allclose(level_1, np.full((16, 4), 0.8 * v / 4**2))
