# SPDX-License-Identifier: BSD-3-Clause
"""Hat functions level by level."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.estimation.hats import HatLevels
from ltcl.acquisition.estimation.windows import hat_matrix

GRIDS = [(1, 1), (1, 7), (5, 5), (9, 16), (33, 20)]


@pytest.mark.parametrize("grid", GRIDS)
def test_hats_are_those_of_all_levels(grid: tuple[int, int]) -> None:
    hats = HatLevels(grid)
    W: np.ndarray = hat_matrix(grid).toarray()
    pixels = np.arange(grid[0] * grid[1])
    assert hats.nodes == len(W)
    np.testing.assert_allclose(hats.at_pixels(pixels).toarray(), W.T, atol=1e-15)
    pictures = np.random.default_rng(1).random((2, *grid))
    flat = pictures.reshape(2, -1).T
    np.testing.assert_allclose(hats.sums_from(0, pictures), W @ flat, atol=1e-12)
    np.testing.assert_allclose(hats.sums_from(0, pictures, power=2), W**2 @ flat, atol=1e-12)
    last = len(hats.sizes) - 1
    np.testing.assert_allclose(hats.sums_from(last, pictures), (W @ flat)[hats.first[last] :])


@pytest.mark.parametrize("grid", GRIDS)
def test_interpolation_goes_through_levels_between(grid: tuple[int, int]) -> None:
    """Values that are interpolated to a finer level, and from there to pixels, are the same."""
    hats = HatLevels(grid)
    pixels = np.arange(grid[0] * grid[1])
    for level in range(len(hats.sizes)):
        at_once = hats.between(level, 0, pixels).toarray()
        np.testing.assert_allclose(at_once.sum(axis=1), 1.0)
        for middle in range(level):
            first = hats.between(level, middle, np.arange(hats.nodes_of(middle))).toarray()
            then = hats.between(middle, 0, pixels).toarray()
            np.testing.assert_allclose(then @ first, at_once, atol=1e-15)
