# SPDX-License-Identifier: BSD-3-Clause
"""Arrays on the device: there and back, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError
from tests import gallery


@pytest.mark.parametrize("shape", [(1,), (53,), (53, 7), (0,), (5, 0)])
@pytest.mark.parametrize("dtype", ["float32", "int32"])
def test_there_and_back(device, shape, dtype):
    values = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    array = device.upload(values, dtype)
    assert (array.shape, array.dtype, array.size, array.nbytes) == (shape, dtype, values.size, values.nbytes)
    assert array.columns == (1 if len(shape) == 1 else shape[1])
    for same in (array, array.copy(), array.like().copy_from(array), array.like().set(values[::1])):
        assert same.get().dtype == dtype
        np.testing.assert_array_equal(same.get(), values)


def test_strided_and_other_types_are_converted(device):
    values = gallery.signed(6, 8).astype(np.float64)
    for view in (values[::2, ::-1], values.T, values[:, 3]):
        np.testing.assert_array_equal(device.upload(view).get(), view.astype(np.float32))


def test_copies_are_independent(device):
    first = device.upload([1.0, 2.0])
    second = first.copy()
    first.set(np.zeros(2))
    assert second.get().tolist() == [1.0, 2.0]


def test_other_shapes_are_refused(device):
    array = device.empty((3, 2))
    with pytest.raises(InputError, match=r"values have shape \(6,\); the array on the device has \(3, 2\)"):
        array.set(np.zeros(6))
    with pytest.raises(InputError, match=r"cannot copy an array of shape \(2, 3\) into one of \(3, 2\)"):
        array.copy_from(device.empty((2, 3)))


@pytest.mark.parametrize("value", [1e39, -1e300])
def test_numbers_beyond_float32_are_refused_instead_of_made_infinite(device, value):
    for act in (lambda: device.upload([value]), lambda: device.empty(1).set(np.array([value]))):
        with pytest.raises(InputError, match="a value is beyond float32"):
            act()


def test_infinite_and_tiny_numbers_pass(device):
    values = np.array([np.inf, -np.inf, np.nan, 1e-45, 3.4e38])
    np.testing.assert_array_equal(device.upload(values).get(), values.astype(np.float32))


@pytest.mark.parametrize("tail", [(), (3,)])
def test_rows_are_copied_out_and_in(device, tail):
    values = np.arange(7 * (3 if tail else 1), dtype=np.float32).reshape(7, *tail)
    x = device.upload(values)
    part = x.rows(2, 3)
    np.testing.assert_array_equal(part.get(), values[2:5])
    assert x.set_rows(4, part) is x
    values[4:7] = values[2:5].copy()
    np.testing.assert_array_equal(x.get(), values)
    assert x.rows(7, 0).shape == (0, *tail)
    with pytest.raises(InputError, match="rows 5 to 8 are not among 7"):
        x.rows(5, 3)
    with pytest.raises(InputError, match="rows 5 on of an array of shape"):
        x.set_rows(5, part)
