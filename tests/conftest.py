# SPDX-License-Identifier: BSD-3-Clause
"""Fixtures of all tests. That CI skips nothing silently is the work of `.ci/no_silent_skips.py`."""

from __future__ import annotations

import os
import signal
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.cli.main import main
from ltcl.device import Device
from ltcl.device.device import SPARE_BYTES
from ltcl.device.kernels import Kernel

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SMALL = 4096  # bytes: a 53 x 53 matrix takes several slabs, its vectors still fit
ROOM = (SMALL - SPARE_BYTES) // 4  # values of the largest array then
# A table of tests with so many cases is long; the default run takes one case in TABLE_STEP of it.
LONG_TABLE = 4
TABLE_STEP = 8
# "2/8": of long tables, also of slow ones, and of all rare tests together, only the cases 2, 10,
# 18, ... are run, counted from 0; of other slow tests every fourth one. CI does so, and goes on by
# one at each commit, so that eight landings run all.
TABLE_PART = os.environ.get("LTCL_TABLE_PART", "0/1")
# How many landings it takes to run every slow test that is neither rare nor a long table.
SLOW_PARTS = 4


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Each test draws its own numbers from its module's `random`, whatever ran before it."""
    names = vars(item.module) if isinstance(item, pytest.Function) else {}
    if isinstance(names.get("random"), np.random.Generator):
        names["random"] = np.random.default_rng(zlib.crc32(item.name.encode()))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Count rare tests, and most cases of long tables, as slow: without `-m ''` every eighth runs.

    Whoever chooses tests by ``-k`` or by the name of a case gets all of them.
    """
    if config.option.keyword:
        return
    part, parts = map(int, TABLE_PART.split("/"))
    left_out: list[pytest.Item] = []
    tables: dict[str, list[pytest.Item]] = {}
    for item in items:
        function, _, _ = item.nodeid.partition("[")
        if item.get_closest_marker("rare"):
            item.add_marker(pytest.mark.slow)
            function = "rare"
        tables.setdefault(function, []).append(item)
    for cases in tables.values():
        if len(cases) < LONG_TABLE:
            continue
        for number, case in enumerate(cases):
            if number % TABLE_STEP > 0:
                case.add_marker(pytest.mark.slow)
            if number % parts != part % parts:
                left_out.append(case)
    if parts > 1:
        left_out += _others_turn(tables, part)
    if left_out:
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


def _others_turn(tables: dict[str, list[pytest.Item]], part: int) -> list[pytest.Item]:
    """The cases of slow tests, long tables aside, whose turn is not at this `part`."""
    slow = []
    for cases in tables.values():
        if len(cases) < LONG_TABLE and any(case.get_closest_marker("slow") for case in cases):
            slow.append(cases)
    waiting: list[pytest.Item] = []
    for number, cases in enumerate(slow):
        if number % SLOW_PARTS != part % SLOW_PARTS:
            waiting += cases
    return waiting


@pytest.fixture(scope="session", autouse=True)
def ctrl_c() -> None:
    """Ctrl-C interrupts, even if a shell that started tests in the background ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def private_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Timings that ltcl remembers during a test run are of no use to anybody else."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LTCL_CACHE", str(folder))
        patch.setenv("LTCL_TUNE", "0")
        yield folder


@pytest.fixture(scope="session")
def device(private_cache: Path) -> Device:
    """The device that ltcl opens here; without one, tests fail rather than skip."""
    return ltcl.open_device()


@pytest.fixture(scope="session")
def room_of_two(private_cache: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two virtual projectors on a corner that were scanned; not to be changed."""
    folder = tmp_path_factory.mktemp("several") / "room"
    words = ["simulate", "dihedral", "--size", "12", "--projectors", "2", "--out", str(folder)]
    assert main([*words, "--strategy", "pixel", "--quiet"]) == 0
    assert main(["acquire", "run", str(folder), "--quiet"]) == 0
    return folder


def launched_as(device: Device, kind: str) -> Device:
    """The same hardware; kernels are launched as on a "cpu" or a "gpu".

    Only tests run the launches of a GPU on a CPU. These kernels are built without optimization,
    which takes two thirds of the time of compiling.
    """
    other = Device(device.description)
    other.kind, kernel = kind, other.kernel

    def unoptimized(file: str, name: str, **defines: Any) -> Kernel:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PYOPENCL_BUILD_OPTIONS", "-cl-opt-disable")
            return kernel(file, name, **defines)

    if device.is_cpu and kind == "gpu":
        vars(other)["kernel"] = unoptimized
    return other


@pytest.fixture
def small_device(device: Device) -> Device:
    """The same hardware with buffers of 4 KiB at most, so that matrices are cut into slabs."""
    small = Device(device.description)
    small.max_allocation = SMALL
    return small


@pytest.fixture(scope="session", params=["cpu", pytest.param("gpu", marks=pytest.mark.slow)])
def shaped(request: pytest.FixtureRequest, device: Device) -> Device:
    """The same hardware; kernels are launched as on a CPU or as on a GPU."""
    return launched_as(device, request.param)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Captures that are not part of the project; they lie beside the checkout, where they exist."""
    if not DATA.is_dir():
        pytest.skip(f"../shared/data is absent ({DATA})")
    return DATA


@pytest.fixture
def disk_without_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    """Flushing matters to power cuts, which `tests/store/test_power_cuts.py` simulates."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)
