# SPDX-License-Identifier: BSD-3-Clause
"""Typed launches."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from ltcl.device import vectors
from ltcl.errors import DeviceError


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1000])
@pytest.mark.parametrize("group", [None, 1, 64])
def test_items_are_rounded_up_to_whole_groups(device, count, group):
    x = vectors.fill(device.empty(1000), -1)
    device.kernel("vector", "vector_fill")(count, group, count, 2, x)
    np.testing.assert_array_equal(x.get(), np.where(np.arange(1000) < count, 2, -1))


def test_no_items_are_no_launch(device):
    x = vectors.fill(device.empty(4), 1)
    with device.profile() as profile:
        device.kernel("vector", "vector_fill")(0, 64, 4, 2, x)
        device.kernel("vector", "vector_dot")((64, 0), (64, 1), 0, 1, 0, x, x, x, 0, device.local(64))
    assert profile.launches == {}
    assert (x.get() == 1).all()


def test_python_numbers_take_the_types_of_the_source(device):
    x = device.empty(3)
    kernel = device.kernel("vector", "vector_fill")
    for value in (1, 1.0, True, np.int64(1), np.float64(1)):
        vectors.fill(x, 0)
        kernel(np.int64(3), 64, np.int64(3), value, x)
        assert (x.get() == 1).all()


def test_groups_beyond_the_devices_are_refused(device):
    kernel = device.kernel("vector", "vector_fill")
    assert 1 <= kernel.largest_group() <= device.max_group
    with pytest.raises(DeviceError, match=r"running vector_fill on .*: OpenCL answered INVALID_WORK_"):
        kernel(1, device.max_group * 2, 1, 0.0, device.empty(1))


def test_threads_may_launch_one_kernel(device):
    """The arguments of a launch are state of the kernel: no thread may see another's."""
    arrays = [vectors.fill(device.empty(256), -1) for _ in range(4)]

    def work(number: int) -> None:
        for _ in range(50):
            vectors.fill(arrays[number], number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number, array in enumerate(arrays):
        assert (array.get() == number).all()
