# SPDX-License-Identifier: BSD-3-Clause
"""Which device is best, and which one a user means; drivers are stood in for by descriptions."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import ltcl
from ltcl.device import discovery
from ltcl.device.discovery import Description
from ltcl.errors import DeviceError, InputTypeError


def describe(index: str, name: str, kind: str, driver: str, units: int = 2) -> Description:
    return Description(index, name, kind, driver.split()[0], driver, units, 1 << 30, 1 << 28, None)


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
    ("select", "found"),
    [
        (None, BIG),
        ("gpu", BIG),
        (" CPU ", NEWER),
        ("accelerator", STRANGE),
        ("4:0", LITTLE),
        ("radeon g", LITTLE),
        ("3.1", NEW),
        ("intel", NEWER),
        ("pocl", NEW),
        ("oclgrind", SIMULATOR),
        ("simulator", SIMULATOR),
    ],
)
def test_selection(select, found):
    assert discovery.choose(ALL, select) is found


@pytest.mark.parametrize("select", ["9:0", "tpu", "cpu"])
def test_selection_of_nothing_lists_what_there_is(select):
    with pytest.raises(DeviceError, match=f"'{select}'") as error:
        discovery.choose([BIG, SIMULATOR], select)
    assert "4:1 Radeon" in str(error.value)
    assert "0:0 Oclgrind" in str(error.value)


@pytest.mark.parametrize(
    ("system", "fix"),
    [
        ("linux", "pip install 'pyopencl[pocl]'"),
        ("darwin", "conda-forge"),
        ("win32", "driver"),
        ("sunos5", "pip"),
    ],
)
def test_no_device_at_all_tells_the_fix_of_the_system(monkeypatch, system, fix):
    monkeypatch.setattr(sys, "platform", system)
    with pytest.raises(DeviceError, match="no OpenCL device") as error:
        discovery.choose([], "gpu")
    assert fix in str(error.value)


def test_no_device_at_all_names_what_may_hide_it(monkeypatch, tmp_path):
    (tmp_path / "home").touch()  # a file: PoCL can make no cache in it
    monkeypatch.delenv("POCL_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home" / "cache"))
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    with pytest.raises(DeviceError, match=r"OCL_ICD_VENDORS=/nowhere.*POCL_CACHE_DIR.*home"):
        discovery.choose([], None)


def test_simulator_is_never_taken_unasked():
    with pytest.raises(DeviceError, match="Oclgrind Simulator"):
        discovery.choose([SIMULATOR], None)


def test_environment_names_the_default(device, monkeypatch):
    monkeypatch.setenv("LTCL_DEVICE", device.description.index)
    assert ltcl.open_device() is device
    assert ltcl.open_device("") is device
    monkeypatch.setenv("LTCL_DEVICE", "no such device")
    with pytest.raises(DeviceError, match="no such device"):
        ltcl.open_device()
    assert ltcl.open_device(device.description.index) is device  # an argument overrides it


def test_a_device_is_opened_once(device):
    assert ltcl.open_device(device) is device
    assert ltcl.open_device(device.description.index) is device
    assert device.description in ltcl.list_devices()


def test_other_types_are_refused():
    with pytest.raises(InputTypeError, match="device is 0"):
        ltcl.open_device(0)  # pyright: ignore[reportArgumentType]


def test_a_machine_without_platforms_has_no_devices(monkeypatch):
    import pyopencl as cl

    def none() -> None:
        raise cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(cl, "get_platforms", none)
    assert ltcl.list_devices() == []


def test_importing_the_device_layer_touches_no_driver():
    code = "import sys, ltcl.device; sys.exit('pyopencl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2]).returncode == 0
