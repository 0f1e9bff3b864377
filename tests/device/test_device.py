# SPDX-License-Identifier: BSD-3-Clause
"""An opened device: limits, the memory pool, threads, processes."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import ltcl
from ltcl.device import Device, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.errors import MemoryLimitError


def test_a_buffer_beyond_the_largest_is_refused_with_both_sizes(small_device):
    most = (small_device.max_allocation - SPARE_BYTES) // 4
    small_device.empty(most)
    with pytest.raises(MemoryLimitError, match=r"3\.988 KiB .*\(1021,\).* 4 KiB"):
        small_device.empty(most + 1)


def test_matrices_beyond_the_memory_are_refused_with_both_sizes(device, monkeypatch):
    """On a CPU also where the host has filled up since."""
    monkeypatch.setattr(device, "memory", 1 << 20)
    device.require(1 << 20, "this")
    with pytest.raises(MemoryLimitError, match=r"that .*1\.5 MiB.* 1 MiB"):
        device.require(3 << 19, "that")
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 100)
    if device.is_cpu:
        with pytest.raises(MemoryLimitError, match="100 B"):
            device.require(101, "that")


def test_memory_is_used_again(device):
    device = Device(device.description)
    for size in (0, 1, 1000, 100_000):
        device.empty(size)
        before = device.allocations
        for _ in range(5):
            device.empty(size)
        assert device.allocations == before


def test_memory_may_be_used_again_while_kernels_are_queued(device):
    """The queue is in order: what is dropped is read before its memory is written anew."""
    total = vectors.fill(device.empty(50_000), 0)
    for number in range(100):
        vectors.axpy(1.0, vectors.fill(device.empty(50_000), number), total)
        vectors.fill(device.empty(50_000), -1)
        device.upload(np.full(50_000, -1))
    assert (total.get() == 4950).all()


def test_unused_blocks_make_room_for_a_large_array(device, monkeypatch):
    device = Device(device.description)
    device.empty(100)
    monkeypatch.setattr(device, "_largest_pooled", 1000)
    device.empty(1000)
    before = device.allocations
    device.empty(100)
    assert device.allocations == before + 1  # nothing unused was left


def test_threads_open_one_device(device, monkeypatch):
    """Where none is open yet; opening takes long enough for all of them to ask."""
    monkeypatch.setattr("ltcl.device.discovery._opened", {})
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
    for number, use in enumerate(uses, 1):
        try:
            use()
            code = number
        except ltcl.errors.DeviceError as error:
            code = code if "spawn" in str(error) and "forkserver" in str(error) else 100
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


def test_opening_a_device_leaves_the_environment_alone_and_reads_no_pickles(device):
    code = (
        "import os, ltcl; before = dict(os.environ); ltcl.open_device(); assert dict(os.environ) == before;"
        "import pyopencl; assert pyopencl._PYOPENCL_NO_CACHE"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0
