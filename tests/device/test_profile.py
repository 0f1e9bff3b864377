# SPDX-License-Identifier: BSD-3-Clause
"""Profiles: what was queued is counted and timed, and the order of what is queued stays."""

from __future__ import annotations

import doctest
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ltcl
from ltcl.device import Device, profile, tuning, vectors
from ltcl.errors import DeviceError
from ltcl.operators import Dense, IdentityPlus


def test_kernels_and_copies_are_counted_with_their_bytes(device):
    x = device.empty((1000, 3))
    with device.profile() as profiled:
        for _ in range(5):
            vectors.fill(x, 2.0)
        x.set(np.ones((1000, 3), np.float32))
        y = x.copy()
        y.get()
        y.get()
    counts = {name: times.launches for name, times in profiled.kernels.items()}
    copies = {name: (times.launches, times.nbytes) for name, times in profiled.copies.items()}
    assert counts == {"vector_fill": 5}
    assert copies == {"upload": (1, 12_000), "copy": (1, 12_000), "download": (2, 24_000)}
    fill = profiled.kernels["vector_fill"]
    assert 0.0 < fill.median <= fill.total < profiled.busy < profiled.seconds
    assert 0.0 < profiled.copy_share < 1.0
    assert all(name in str(profiled) for name in ("vector_fill", "upload", "busy"))


def test_a_solve_is_the_same_and_all_its_launches_count(device):
    matrix = np.full((64, 64), 0.5 / 64, np.float32)
    S = IdentityPlus(Dense(device, matrix))
    b = np.arange(64.0)
    expected = ltcl.solve(S, b, "chebyshev").x
    before = device.launches.copy()
    with device.profile() as profiled:
        solution = ltcl.solve(S, b, "chebyshev")
    np.testing.assert_array_equal(solution.x, expected)
    launched = device.launches - before
    assert {name: times.launches for name, times in profiled.kernels.items()} == launched


def test_nothing_is_noted_outside_and_inner_profiles_count_in_outer_ones(device):
    x = device.empty(10)
    with device.profile() as outer:
        vectors.fill(x, 1.0)
        with device.profile() as inner:
            vectors.fill(x, 2.0)
        vectors.fill(x, 3.0)
    vectors.fill(x, 4.0)
    assert inner.kernels["vector_fill"].launches == 1
    assert outer.kernels["vector_fill"].launches == 3
    with device.profile() as empty:
        pass
    assert (empty.kernels, empty.copies, empty.copy_share) == ({}, {}, 0.0)


def test_an_error_inside_ends_the_profile(device):
    plain = device.queue
    with pytest.raises(ZeroDivisionError), device.profile():
        raise ZeroDivisionError
    assert device.queue is plain
    assert device.session.profiles == []


def test_what_is_queued_keeps_its_order_while_threads_begin_and_end_profiles(device):
    """The sum of 0, 1, 2, ... needs every launch to come after the one before."""
    own = Device(device.description)
    total = vectors.fill(own.empty(50_000), 0.0)
    number = own.empty(50_000)
    is_over = threading.Event()

    def profile_again_and_again() -> None:
        while not is_over.is_set():
            with own.profile():
                time.sleep(1e-4)

    thread = threading.Thread(target=profile_again_and_again)
    thread.start()
    try:
        for value in range(300):
            vectors.fill(number, value)
            vectors.axpy(1.0, number, total)
        assert (total.get() == sum(range(300))).all()
    finally:
        is_over.set()
        thread.join()


def test_long_profiles_read_events_on_the_way(device, monkeypatch):
    monkeypatch.setattr(profile, "MAX_WAITING", 10)
    x = device.empty(10)
    with device.profile() as profiled:
        for _ in range(10):
            for _ in range(10):
                vectors.fill(x, 1.0)
            device.finish()
    assert profiled.kernels["vector_fill"].launches == 100


def test_a_device_without_a_clock_is_refused(device, monkeypatch):
    timeless = Device(device.description)
    monkeypatch.setattr(timeless, "handle", SimpleNamespace(queue_properties=0))
    assert not timeless.has_clock
    with pytest.raises(DeviceError, match="keeps no times"), timeless.profile():
        pass


@pytest.fixture
def tuned(monkeypatch, tmp_path):
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path))
    monkeypatch.delenv("LTCL_TUNE")


def test_the_tuner_goes_by_the_clock_of_the_device(device, monkeypatch, tuned):
    """The host sleeps before the faster variant, which is chosen all the same."""
    large, small = device.empty(1 << 22), device.empty(1 << 10)

    def fast() -> None:
        time.sleep(0.02)
        vectors.fill(small, 1.0)

    variants = {"slow": lambda: vectors.fill(large, 1.0) and None, "fast": fast}
    assert tuning.choose(device, "vector", "by the device", variants) == "fast"
    assert tuning.work_seconds(device, "fast", fast) < 0.02 < tuning.seconds(device, "fast", fast)


def test_the_tuner_takes_the_host_where_the_device_has_no_clock(device, monkeypatch, tuned):
    monkeypatch.setattr(Device, "has_clock", False)
    x = device.empty(10)

    def late() -> None:
        time.sleep(0.01)
        vectors.fill(x, 1.0)

    assert tuning.work_seconds(device, "late", late) > 0.01


def test_the_page_on_gpus_runs(device):
    root = Path(__file__).resolve().parents[2]
    page = str(root / "docs" / "guide" / "gpu.md")
    failed, tried = doctest.testfile(page, module_relative=False)
    assert (failed, tried > 4) == (0, True)
