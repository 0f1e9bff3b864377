# SPDX-License-Identifier: BSD-3-Clause
"""Orders of pixels and coefficients: each once, neighbours together, on grids of any size."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import pywt

from ltcl.errors import InputError
from ltcl.operators.orders import hilbert, relatives

GRIDS = [
    *itertools.product(range(1, 20), range(1, 20)),
    (1, 301),
    (301, 1),
    (2, 97),
    (64, 64),
    (45, 91),
    (90, 127),
]


def test_curves_pass_every_pixel_once_and_go_on_to_a_neighbour():
    for h, w in GRIDS:
        order = hilbert((h, w))
        np.testing.assert_array_equal(np.sort(order), np.arange(h * w))
        y, x = np.divmod(order, w)
        assert np.all(np.abs(np.diff(y)) + np.abs(np.diff(x)) == 1), (h, w)


def test_a_square_of_a_power_of_two_is_filled_quarter_by_quarter():
    y, x = np.divmod(hilbert((16, 16)), 16)
    for size in (2, 4, 8):  # each run of size^2 places is an aligned square of that side: Hilbert's own curve
        for values in (y, x):
            cells = values.reshape(-1, size * size) // size
            assert np.all(cells == cells[:, :1])


@pytest.mark.parametrize("grid", [(64, 64), (45, 91), (128, 17)])
def test_stretches_of_a_curve_stay_in_one_place(grid):
    y, x = np.divmod(hilbert(grid), grid[1])
    n = 64 * (len(y) // 64)
    spread = [np.ptp(values[:n].reshape(-1, 64), axis=1).mean() for values in (y, x)]
    assert sum(spread) < 24  # a square of 64 pixels has 14, a row of them 63


@pytest.mark.parametrize("grid", [(1, 1), (1, 7), (6, 1), (5, 8), (16, 32), (45, 91)])
@pytest.mark.parametrize("levels", [0, 1, 3])
def test_relatives_are_all_coefficients_from_coarse_to_fine(grid, levels):
    order = relatives(grid, levels)
    np.testing.assert_array_equal(np.sort(order), np.arange(grid[0] * grid[1]))
    level = _levels(grid, levels)[order]
    assert np.all(np.diff(level) <= 0)


def test_the_details_of_a_place_stand_together():
    h, w = 16, 32
    order = relatives((h, w), 2)
    y, x = np.divmod(order[-3 * (h // 2) * (w // 2) :], w)  # the finest level
    places = np.stack([y % (h // 2), x % (w // 2)], axis=1).reshape(-1, 3, 2)
    assert np.all(places == places[:, :1])
    assert np.all(np.abs(np.diff(places[:, 0], axis=0)).sum(axis=1) == 1)


def test_order_without_levels_is_the_curve():
    np.testing.assert_array_equal(relatives((9, 14), 0), hilbert((9, 14)))


def test_the_layout_is_that_of_the_transform():
    """A bump that only one place sees has its coefficients of a level in one run, of a band each."""
    picture = np.zeros((32, 64))
    picture[8:10, 20:22] = [[4, -2], [1, 3]]
    coefficients = pywt.coeffs_to_array(pywt.wavedec2(picture, "haar", "periodization", level=3))[0].ravel()
    order = relatives((32, 64), 3)
    level = _levels((32, 64), 3)
    for one in range(3):
        places = np.flatnonzero((coefficients[order] != 0) & (level[order] == one))
        assert len(places) > 0
        assert np.ptp(places) < 3


def _levels(grid: tuple[int, int], levels: int) -> np.ndarray:
    """Level of each coefficient, (N,): 0 is the finest, `levels` the approximation."""
    found = np.zeros(grid, int)
    h, w = grid
    for level in range(1, levels + 1):
        h, w = -(-h // 2), -(-w // 2)
        found[:h, :w] = level
    return found.ravel()


@pytest.mark.parametrize("grid", [(0, 3), (3,), (2.5, 2), "ab", None])
def test_what_is_no_grid_is_refused(grid):
    with pytest.raises(InputError, match="grid is"):
        hilbert(grid)
    with pytest.raises(InputError, match="grid is"):
        relatives(grid, 1)


@pytest.mark.parametrize("levels", [-1, 1.5, None])
def test_what_is_no_number_of_levels_is_refused(levels):
    with pytest.raises(InputError, match="levels is"):
        relatives((4, 4), levels)
