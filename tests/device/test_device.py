# SPDX-License-Identifier: BSD-3-Clause
"""An opened device: limits, memory, profiling."""

from __future__ import annotations

import pytest

from ltcl.device import vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import MemoryLimitError


def test_facts_come_from_the_driver(device):
    assert device.name in repr(device)
    assert device.kind in ("gpu", "cpu", "accelerator", "simulator")
    assert device.is_cpu == (device.kind in ("cpu", "simulator"))
    for number in (
        device.compute_units,
        device.max_group,
        device.local_memory,
        device.max_allocation,
        device.memory,
    ):
        assert number > 0


def test_a_buffer_beyond_the_largest_is_refused_with_both_sizes(small_device):
    most = (small_device.max_allocation - SPARE_BYTES) // 4
    small_device.empty(most)
    with pytest.raises(MemoryLimitError, match=r"a buffer of 3\.988 KiB .*\(1021,\).* allows, 4 KiB"):
        small_device.empty(most + 1)


def test_matrices_beyond_the_memory_are_refused_with_both_sizes(device, monkeypatch):
    monkeypatch.setattr(device, "memory", 1 << 20)
    device.require(1 << 20, "this")
    with pytest.raises(
        MemoryLimitError, match=r"that needs 1\.5 MiB, but .* has 1 MiB; threshold or compress"
    ):
        device.require(3 << 19, "that")


def test_a_host_that_filled_up_since_is_noticed(device, monkeypatch):
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 100)
    if device.is_cpu:
        with pytest.raises(MemoryLimitError, match="has 100 B"):
            device.require(101, "that")
    else:
        device.require(101, "that")


def test_profiles_count_launches_and_device_time(device):
    x = device.empty(100)
    vectors.fill(x, 1)  # before: not counted
    with device.profile() as outer:
        vectors.fill(x, 1)
        with device.profile() as inner:
            vectors.fill(x, 2)
            vectors.norm(x)
    vectors.fill(x, 3)
    assert inner.launches == {"vector_fill": 1, "vector_dot": 1}
    assert outer.launches == {"vector_fill": 2, "vector_dot": 1}
    assert all(0 <= inner.seconds[name] <= outer.seconds[name] < 60 for name in inner.seconds)


def test_profiles_end_when_their_block_fails(device):
    queue = device.queue
    with pytest.raises(KeyError), device.profile():
        raise KeyError
    assert device.queue is queue
    assert (vectors.fill(device.empty(3), 1).get() == 1).all()
