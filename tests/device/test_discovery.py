# SPDX-License-Identifier: BSD-3-Clause
"""Which device is best, and which one a user means; drivers are stood in for by descriptions."""

from __future__ import annotations

import sys

import pyopencl as cl
import pytest

import ltcl
from ltcl.device import discovery
from ltcl.device.discovery import Description
from ltcl.errors import DeviceError, InputTypeError


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


@pytest.mark.parametrize(
    ("select", "device"),
    [
        (None, BIG),
        (" CPU ", NEWER),
        ("accelerator", STRANGE),
        ("4:0", LITTLE),
        ("radeon g", LITTLE),
        ("3.1", NEW),
        ("pocl", NEW),
        ("simulator", SIMULATOR),
    ],
)
def test_selection(select, device):
    assert discovery.choose(ALL, select) is device


@pytest.mark.parametrize(
    ("select", "kind"), [("9:0", "index"), ("tpu", "name"), ("cpu", "CPU"), ("accelerator", "accelerator")]
)
def test_selection_of_nothing_lists_what_there_is(select, kind):
    with pytest.raises(DeviceError, match=f"'{select}'.* {kind} .*4:1 Radeon.*0:0 Oclgrind"):
        discovery.choose([BIG, SIMULATOR], select)


@pytest.mark.parametrize("system", ["linux", "darwin", "win32", "sunos5"])
def test_no_device_at_all_names_a_driver_and_what_may_hide_it(monkeypatch, system):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    fix = {"darwin": "conda-forge", "win32": "Intel"}.get(system, "pocl")
    with pytest.raises(DeviceError, match=f"OCL_ICD_VENDORS=/nowhere.*{fix}"):
        discovery.choose([], "gpu")


def test_a_simulator_is_never_taken_unasked():
    with pytest.raises(DeviceError, match="Oclgrind Simulator"):
        discovery.choose([SIMULATOR], None)


def test_the_environment_names_the_default(device, monkeypatch):
    index = device.description.index
    monkeypatch.setenv("LTCL_DEVICE", index)
    assert ltcl.open_device() is ltcl.open_device("") is ltcl.open_device(device) is device
    assert device.description in ltcl.list_devices()
    monkeypatch.setenv("LTCL_DEVICE", "no such device")
    with pytest.raises(DeviceError, match="no such device"):
        ltcl.open_device()
    assert ltcl.open_device(index) is device  # an argument overrides it


def test_other_types_are_refused():
    with pytest.raises(InputTypeError, match="device is 0"):
        ltcl.open_device(0)  # pyright: ignore[reportArgumentType]


def test_a_machine_without_platforms_has_no_devices(monkeypatch):
    def none() -> None:
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", none)
    assert ltcl.list_devices() == []
