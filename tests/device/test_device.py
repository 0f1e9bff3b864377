# SPDX-License-Identifier: BSD-3-Clause
"""An opened device: limits, the memory pool, profiling, threads, processes."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pyopencl as cl
import pytest
from pyopencl import _cl

import ltcl
from ltcl.device import Device, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import MemoryLimitError


def test_facts_come_from_the_driver(device):
    assert device.name in repr(device)
    assert device.kind in ("gpu", "cpu", "accelerator", "simulator")
    facts = ("compute_units", "max_group", "local_memory", "max_allocation", "memory")
    assert all(getattr(device, fact) > 0 for fact in facts)


def test_a_buffer_beyond_the_largest_is_refused_with_both_sizes(small_device):
    most = (small_device.max_allocation - SPARE_BYTES) // 4
    small_device.empty(most)
    with pytest.raises(MemoryLimitError, match=r"3\.988 KiB .*\(1021,\).* 4 KiB"):
        small_device.empty(most + 1)


def test_matrices_beyond_the_memory_are_refused_with_both_sizes(device, monkeypatch):
    monkeypatch.setattr(device, "memory", 1 << 20)
    device.require(1 << 20, "this")
    with pytest.raises(MemoryLimitError, match=r"that .*1\.5 MiB.* 1 MiB"):
        device.require(3 << 19, "that")


def test_a_host_that_filled_up_since_is_noticed(device, monkeypatch):
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 100)
    if device.is_cpu:
        with pytest.raises(MemoryLimitError, match="100 B"):
            device.require(101, "that")
    else:
        device.require(101, "that")


def test_memory_is_used_again(device):
    device = Device(device.description)
    for size in (0, 1, 1000, 100_000):
        device.empty(size)
        before = device.allocations
        for _ in range(5):
            device.empty(size)
        assert device.allocations == before
        both = device.empty(size), device.empty(size)
        assert device.allocations == before + 1, both


def test_memory_may_be_used_again_while_kernels_are_queued(device):
    """The queue is in order: what is dropped is read before its memory is written anew."""
    total = vectors.fill(device.empty(50_000), 0)
    for number in range(100):
        vectors.axpy(1.0, vectors.fill(device.empty(50_000), number), total)
        vectors.fill(device.empty(50_000), -1)
        device.upload(np.full(50_000, -1))
    assert (total.get() == 4950).all()


@pytest.mark.parametrize("failures", [1, 2])
def test_unused_blocks_make_room_for_a_large_array(device, monkeypatch, failures):
    device = Device(device.description)
    monkeypatch.setattr(device, "_largest_pooled", 4000)
    buffer, tried = cl.Buffer, []

    def short_of_memory(*arguments):
        tried.append(device._pool.held_blocks)
        if len(tried) <= failures:
            code = cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE
            raise cl.MemoryError(_cl._ErrorRecord(msg="", code=code, routine="clCreateBuffer"))
        return buffer(*arguments)

    device.empty(500)
    monkeypatch.setattr(cl, "Buffer", short_of_memory)
    if failures == 1:
        assert device.upload(np.ones(1000)).get().sum() == 1000
    else:
        with pytest.raises(MemoryLimitError, match=r"3\.906 KiB"):
            device.empty(1000)
    assert tried == [1, 0]


def test_profiles_count_launches_and_device_time(device):
    x = device.empty(100)
    vectors.fill(x, 1)  # before: not counted
    with device.profile() as outer:
        vectors.fill(x, 1)
        with device.profile() as inner:
            vectors.fill(x, 2)
            vectors.norm(x)
    with pytest.raises(KeyError), device.profile():
        raise KeyError
    vectors.fill(x, 3)
    assert inner.launches == {"vector_fill": 1, "vector_dot": 1}
    assert outer.launches == {"vector_fill": 2, "vector_dot": 1}
    assert all(0 <= inner.seconds[name] <= outer.seconds[name] < 60 for name in inner.seconds)


def test_profiles_see_their_own_thread(device):
    """And leave the order of the others' launches alone."""
    x, ready, over = device.empty(100), threading.Event(), threading.Event()

    def work() -> int:
        ready.set()
        count = 0
        while not over.is_set():
            vectors.fill(x, 1)
            count += 1
        return count

    with ThreadPoolExecutor(1) as pool:
        others = pool.submit(work)
        ready.wait()
        with device.profile() as profile:
            vectors.norm(device.upload([3.0, 4.0]))
        over.set()
    assert others.result() > 0
    assert profile.launches == {"vector_dot": 1}


def test_threads_open_one_device(device, monkeypatch):
    """Where none is open yet; opening takes long enough for all of them to ask."""
    from ltcl.device import discovery

    monkeypatch.setattr(discovery, "_opened", {})
    together = threading.Barrier(8)

    def work(_: int) -> Device:
        together.wait()
        return ltcl.open_device(device.description.index)

    with ThreadPoolExecutor(8) as pool:
        assert len({id(opened) for opened in pool.map(work, range(8))}) == 1


FORK = """
import multiprocessing, os, sys, warnings
warnings.simplefilter("ignore")  # of Python, that other threads are running
import numpy as np, ltcl
from ltcl.device import vectors
device = ltcl.open_device(sys.argv[1])
x = vectors.fill(device.empty(1000), 1.0)
kernel = device.kernel("vector", "vector_fill")
launch = kernel.bind(1000, 64, 1000, 2.0, x)
S = ltcl.operators.Dense(device, np.eye(3))
device.finish()
uses = [
    lambda: ltcl.open_device(sys.argv[1]), lambda: device.empty(3), lambda: device.finish(), lambda: x.get(),
    lambda: x.set(np.ones(1000)), lambda: vectors.norm(x), launch, lambda: kernel(1, 1, 1, 1.0, x),
    lambda: device.kernel("vector", "vector_dot"), lambda: S @ np.ones(3), lambda: x.copy(),
    lambda: ltcl.solve(S, np.ones(3), "cg"),
]
child = os.fork()
if child == 0:
    code = 0
    for number, use in enumerate(uses):
        try:
            use()
            code = 1 + number
        except ltcl.errors.DeviceError as error:
            if not ("spawn" in str(error) and "forkserver" in str(error)):
                code = 100
    del x, launch, S, uses
    os._exit(code)
code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
with multiprocessing.get_context("fork").Pool(1) as pool:  # the error has to come through its pipe
    try:
        pool.map(ltcl.open_device, [sys.argv[1]])
    except ltcl.errors.DeviceError:
        assert (x.get() == 1).all()
        sys.exit(code)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_is_refused_and_does_not_hang(device):
    run = [sys.executable, "-c", FORK, device.description.index]
    assert subprocess.run(run, timeout=120).returncode == 0


def test_opening_a_device_leaves_the_environment_alone(device):
    code = (
        "import os, ltcl; before = dict(os.environ); ltcl.open_device(); "
        "import pyopencl; assert pyopencl._PYOPENCL_NO_CACHE; assert dict(os.environ) == before"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0
