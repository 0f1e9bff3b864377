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


def test_numbers_beyond_float32_are_refused_and_others_pass(device):
    for act in (lambda: device.upload([1e39]), lambda: device.empty(1).set(np.array([-1e300]))):
        with pytest.raises(InputError, match="float32"):
            act()
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


def test_what_does_not_fit_is_refused(device):
    x = device.empty((3, 2))
    for act, match in (
        (lambda: x.set(np.zeros(6)), r"\(6,\).*\(3, 2\)"),
        (lambda: x.copy_from(device.empty((2, 3))), r"\(2, 3\).*\(3, 2\)"),
        (lambda: x.rows(2, 2), "2 to 4 .*3"),
        (lambda: x.set_rows(2, x), "rows 2"),
    ):
        with pytest.raises(InputError, match=match):
            act()
