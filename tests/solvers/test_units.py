# SPDX-License-Identifier: BSD-3-Clause
"""Units of right-hand sides: powers of two change no digit, in float32 as in float64."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.solvers import units

rng = np.random.default_rng(9)
SIZES = (1e-44, 1e-38, 1e-3, 1.0, 7.0, 3e38)


def _columns(dtype):
    return (rng.uniform(-1.0, 1.0, (50, len(SIZES))) * np.array(SIZES)).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_units_are_near_the_largest_value(dtype):
    b = _columns(dtype)
    sizes = np.max(np.abs(b.astype(np.float64)), axis=0)
    np.testing.assert_array_equal(units.largest(b), sizes)
    unit = units.of(b)
    assert np.all((sizes >= unit) & (sizes < 2 * unit))
    assert np.all(np.log2(unit) % 1.0 == 0.0)
    assert units.of(0 * b[:, 0]) == 1.0
    assert units.of(np.array([-128], np.int8)) == 128.0
    assert np.isnan(units.largest(np.array([1.0, np.nan])))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("columns", [slice(None), slice(2, 5)], ids=["all", "normal"])
def test_scaling_there_and_back_loses_no_bit(dtype, columns):
    b = _columns(dtype)[:, columns]
    unit = units.of(b)
    small = units.scaled(b, unit).astype(np.float32)
    np.testing.assert_array_equal(small, (b.astype(np.float64) / unit).astype(np.float32))
    back = units.restored(small, unit)
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, (small.astype(np.float64) * unit).astype(np.float32))


def test_what_is_beyond_float32_comes_back_in_float64():
    unit = np.exp2(np.array([127.0]))
    x = np.array([[3.0], [1.0]], np.float32)
    back = units.restored(x, unit)
    assert back.dtype == np.float64
    np.testing.assert_array_equal(back, x * unit)
    assert units.restored(x / 2, unit).dtype == np.float32
