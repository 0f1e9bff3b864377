# SPDX-License-Identifier: BSD-3-Clause
"""Functions in which rows of T are written."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.estimation.windows import (
    Windows,
    functions_of_row,
    hat_levels,
    hat_matrix,
    sums_under_hats,
)
from ltcl.operators import Hats
from tests import reference

GRIDS = [(1, 1), (1, 7), (5, 5), (9, 16), (33, 20)]


@pytest.mark.parametrize("grid", GRIDS)
def test_hats_are_those_of_the_basis(device, grid):
    W = hat_matrix(grid)
    assert tuple(hat_levels(grid)) == Hats(device, grid).levels
    np.testing.assert_allclose(W.toarray(), reference.hats_gather(grid), rtol=0, atol=1e-15)


@pytest.mark.parametrize("grid", GRIDS)
def test_windows_hold_the_pixel_itself_once_and_no_function_twice(grid):
    windows = Windows.of(grid)
    pixels = grid[0] * grid[1]
    assert windows.nodes.shape == (pixels, functions_of_row(grid))
    own = windows.nodes == np.arange(pixels)[:, None]
    assert np.all(own.sum(axis=1) == 1)
    assert np.all(windows.group[own.argmax(axis=1)] == 0)
    for nodes in windows.nodes:
        present = nodes[nodes != windows.absent]
        assert len(np.unique(present)) == len(present)


@pytest.mark.parametrize("grid", GRIDS)
def test_smooth_light_from_everywhere_can_be_written(grid):
    """The last level covers the whole picture: every bilinear row is a sum of the functions."""
    windows = Windows.of(grid)
    W = hat_matrix(grid).toarray()
    y, x = np.indices(grid).reshape(2, -1)
    row = 1.0 + 0.3 * y - 0.1 * x + 0.02 * x * y
    for pixel in (0, len(row) // 2, len(row) - 1):
        nodes = windows.nodes[pixel]
        functions = W[nodes[nodes != windows.absent]]
        shares = np.linalg.lstsq(functions.T, row, rcond=None)[0]
        np.testing.assert_allclose(functions.T @ shares, row, rtol=0, atol=1e-9)


def test_sums_end_in_a_zero_for_functions_that_are_absent():
    W = hat_matrix((4, 6))
    patterns = [np.ones(24), np.arange(24.0)]
    sums = sums_under_hats(W, patterns)
    assert np.all(sums[-1] == 0.0)
    np.testing.assert_allclose(sums[:-1], W @ np.transpose(patterns))
