# SPDX-License-Identifier: BSD-3-Clause
"""Rows of a corner's A that are never stored, against the matrix of `dihedral`."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ltcl.errors import InputError
from ltcl.scenes import CornerRows, dihedral


@given(st.integers(1, 5), st.data())
def test_any_rows_are_those_of_the_dihedral(n, data):
    start = data.draw(st.integers(0, 2 * n * n))
    stop = data.draw(st.integers(start, 2 * n * n))
    rows = CornerRows(n, albedo=(0.5, 0.25))
    A = dihedral(n, albedo=(0.5, 0.25)).A
    assert rows.rows(start, stop).dtype == np.float32
    np.testing.assert_allclose(rows.rows(start, stop), A[start:stop], rtol=1e-6, atol=1e-9)


@given(st.integers(1, 6), st.integers(0, 3))
def test_a_product_is_that_of_the_rows(n, columns):
    rows = CornerRows(n, albedo=(0.5, 0.25))
    shape = (2 * n * n, columns) if columns else (2 * n * n,)
    x = np.random.default_rng(n).standard_normal(shape)
    exact = rows.rows(0, 2 * n * n).astype(np.float64) @ x
    np.testing.assert_allclose(rows.matmat(x), exact, rtol=1e-6, atol=1e-6)


def test_a_product_takes_pictures_of_its_size_alone():
    with pytest.raises(InputError, match=r"x has shape \(3, 2\); it must be \(8, 2\)"):
        CornerRows(2).matmat(np.ones((3, 2)))


def test_grid_and_first_bounce_are_those_of_the_dihedral():
    rows, scene = CornerRows(3, albedo=(0.5, 0.25)), dihedral(3, albedo=(0.5, 0.25))
    assert rows.grid == scene.grid
    assert rows.shape == (18, 18)
    np.testing.assert_array_equal(rows.first_bounce, scene.first_bounce)


@pytest.mark.parametrize("albedo", [(0.5, 0.4, 0.3), 1.0, -0.1, float("nan")])
def test_albedos_of_three_colours_or_out_of_range_are_refused(albedo):
    with pytest.raises(InputError, match="albedo"):
        CornerRows(2, albedo)


@pytest.mark.parametrize("rows", [(-1, 2), (3, 2), (0, 9)])
def test_rows_that_are_not_there_are_refused(rows):
    with pytest.raises(InputError, match=f"rows {rows[0]} to {rows[1]}"):
        CornerRows(2).rows(*rows)
