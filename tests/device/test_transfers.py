# SPDX-License-Identifier: BSD-3-Clause
"""Transfers: values arrive whatever queue is late, and copies overlap the work of kernels.

A queue is made late by an event that only the test sets.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ltcl.device import Array, Device, transfers, vectors
from ltcl.errors import InputError

N = 1000
WAYS = (transfers.DIRECT, transfers.PINNED)
QUEUES = ("queue", "uploads", "downloads")
SECONDS = 20.0


@pytest.fixture
def pinned(monkeypatch):
    monkeypatch.setenv(transfers.VARIABLE, transfers.PINNED)


@contextlib.contextmanager
def held(device: Device, *names: str) -> Iterator[None]:
    """Let queues of a device begin nothing before the end of the block."""
    import pyopencl as cl

    gate = cl.UserEvent(device.context)
    for name in names:
        queue = getattr(device.session, name)
        cl.enqueue_barrier(queue, wait_for=[gate])
        queue.flush()
    try:
        yield
    finally:
        gate.set_status(cl.command_execution_status.COMPLETE)


def numbers(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random(N, dtype=np.float32)


class Doubled:
    """Twice the values of the host: a copy up, a launch, a copy down."""

    def __init__(self, device: Device) -> None:
        self.device = device
        self.values = transfers.upload(device.empty(N))
        self.result = transfers.download(device.empty(N))
        x, out = self.values.array, self.result.array
        self.double = vectors.bind_axpby(1.0, x, 1.0, x, out)

    def begin(self, values: np.ndarray) -> None:
        np.copyto(self.values.host, values)
        self.values.send()
        self.result.make_room()
        launched = self.double()
        self.values.release(launched)
        self.result.send(launched)
        self.device.flush()


def has_ended(event: Any) -> bool:
    """Whether an event comes to its end while others are held."""
    import pyopencl as cl

    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        if event.command_execution_status == cl.command_execution_status.COMPLETE:
            return True
        time.sleep(1e-3)
    return False


@pytest.mark.parametrize("way", WAYS)
def test_values_of_many_rounds(device, monkeypatch, way):
    monkeypatch.setenv(transfers.VARIABLE, way)
    frames = [Doubled(device) for _ in range(3)]
    results = []
    for seed in range(30):
        frame = frames[seed % 3]
        if seed >= 3:
            results.append(frame.result.take())
        frame.begin(numbers(seed))
    results += [frames[seed % 3].result.take() for seed in range(27 + 3, 30 + 3)]
    for seed, result in enumerate(results):
        np.testing.assert_array_equal(result, 2 * numbers(seed), err_msg=f"round {seed}")


@pytest.mark.parametrize("names", [*((name,) for name in QUEUES), QUEUES])
def test_values_are_right_whichever_queue_is_late(device, pinned, names):
    """Three frames take turns; none is taken before all are queued."""
    frames = [Doubled(device) for _ in range(3)]
    with held(device, *names):
        for seed, frame in enumerate(frames):
            frame.begin(numbers(seed))
    for seed, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.result.take(), 2 * numbers(seed))


def test_the_next_values_wait_for_the_launch_that_reads_the_last(device, pinned):
    """The copy up ends while kernels are held; the next one must not."""
    frame = Doubled(device)
    first = device.empty(N)
    vectors.fill(first, 0.0)
    with held(device, "queue"):
        np.copyto(frame.values.host, numbers(1))
        frame.values.send()
        frame.values.release(vectors.bind_axpby(1.0, frame.values.array, 0.0, first, first)())
        # `host` waits until the first values have left it.
        np.copyto(frame.values.host, numbers(2))
        frame.values.send()
        frame.values.release(frame.double())
        time.sleep(0.05)
    np.testing.assert_array_equal(first.get(), numbers(1))
    np.testing.assert_array_equal(frame.result.array.get(), 2 * numbers(2))


def test_the_next_launch_waits_for_the_copy_down(device, pinned):
    frame = Doubled(device)
    with held(device, "downloads"):
        frame.begin(numbers(1))
        frame.result.make_room()
        vectors.fill(frame.result.array, -1.0)
        device.flush()
        time.sleep(0.05)
    np.testing.assert_array_equal(frame.result.take(), 2 * numbers(1))
    assert (frame.result.array.get() == -1.0).all()


def test_memory_of_a_queued_launch_is_not_written_by_an_upload(device, pinned):
    """A block that is free again may still be read by what is queued."""
    own = Device(device.description)
    vectors.fill(own.empty(N), 0.0)
    copied = own.empty(N)
    x = own.upload(numbers(1))
    block = x.buffer.int_ptr
    with held(own, "queue"):
        vectors.axpby(1.0, x, 0.0, x, copied)
        del x
        values = transfers.upload(own.empty(N))
        assert values.array.buffer.int_ptr == block
        np.copyto(values.host, numbers(2))
        values.send()
        time.sleep(0.05)
    np.testing.assert_array_equal(copied.get(), numbers(1))


def test_a_copy_down_that_nobody_takes_ends_before_its_memory_is_free(device, pinned):
    frame = Doubled(device)
    frame.begin(numbers(1))
    waited = []
    frame.result._sent = SimpleNamespace(wait=lambda: waited.append(1))
    del frame
    assert waited


def test_copies_up_and_down_overlap_with_kernels(device, pinned):
    """While the kernels of one frame are held, the next one goes up, and the last one down."""
    last, now, following = (Doubled(device) for _ in range(3))
    last.begin(numbers(1))
    device.finish()
    with held(device, "queue"):
        now.begin(numbers(2))
        taken = last.result.take()
        np.copyto(following.values.host, numbers(3))
        following.values.send()
        assert has_ended(following.values._sent)
    np.testing.assert_array_equal(taken, 2 * numbers(1))
    np.testing.assert_array_equal(now.result.take(), 2 * numbers(2))


@pytest.mark.parametrize("way", WAYS)
def test_profiles_count_copies_both_ways(device, monkeypatch, way):
    monkeypatch.setenv(transfers.VARIABLE, way)
    frame = Doubled(device)
    with device.profile() as profiled:
        for seed in range(3):
            frame.begin(numbers(seed))
            frame.result.take()
    counts = {name: (times.launches, times.nbytes) for name, times in profiled.copies.items()}
    assert counts == {"upload": (3, 3 * 4 * N), "download": (3, 3 * 4 * N)}
    assert profiled.copies["upload"].total > 0.0


@pytest.mark.parametrize(
    ("kind", "shares_memory", "expected"),
    [("cpu", True, False), ("cpu", False, False), ("gpu", True, False), ("gpu", False, True)],
)
def test_what_the_device_says_decides(device, monkeypatch, kind, shares_memory, expected):
    monkeypatch.delenv(transfers.VARIABLE, raising=False)
    own = Device(device.description)
    own.kind = kind
    own.handle = SimpleNamespace(host_unified_memory=shares_memory)
    assert transfers.are_pinned(own) == expected
    for way in WAYS:
        monkeypatch.setenv(transfers.VARIABLE, way)
        assert transfers.are_pinned(own) == (way == transfers.PINNED)


def test_another_word_is_refused(device, monkeypatch):
    monkeypatch.setenv(transfers.VARIABLE, "fast")
    array: Array = device.empty(3)
    for make in (transfers.upload, transfers.download):
        with pytest.raises(InputError, match=r"LTCL_TRANSFERS is 'fast'.*pinned.*direct"):
            make(array)
