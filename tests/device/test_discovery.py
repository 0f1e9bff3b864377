# SPDX-License-Identifier: BSD-3-Clause
"""Which device is best, and which one a user means; drivers are stood in for by descriptions."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import ltcl
from ltcl.device import discovery
from ltcl.device.description import Description
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


@pytest.mark.parametrize(
    ("older", "newer"), [("3.0-rc2", "3.1+debian"), ("3.0", "3.0.1"), ("9.2", "10.0"), ("none", "0.1")]
)
def test_newer_drivers_come_first(older, newer):
    devices = [describe(f"{i}:0", "cpu", "cpu", f"PoCL {driver}") for i, driver in enumerate((older, newer))]
    assert min(devices, key=lambda device: device.rank).driver == f"PoCL {newer}"


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


@pytest.mark.parametrize("select", ["9:0", "tpu"])
def test_selection_of_nothing_lists_what_there_is(select):
    with pytest.raises(DeviceError, match=f"device is '{select}'; it must be gpu, cpu") as error:
        discovery.choose([BIG, SIMULATOR], select)
    assert "4:1 Radeon (gpu); 0:0 Oclgrind Simulator (simulator)" in str(error.value)


def test_a_kind_that_is_missing_is_said():
    with pytest.raises(DeviceError, match=r"^no cpu here; there are: 4:1 Radeon \(gpu\)$"):
        discovery.choose([BIG], "cpu")


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
    for name in discovery._HIDING:
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(DeviceError, match=r"^no OpenCL device was found; install a driver: ") as error:
        discovery.choose([], "gpu")
    assert fix in str(error.value)


def test_no_device_at_all_names_the_variables_that_may_hide_it(monkeypatch):
    monkeypatch.setenv("OCL_ICD_VENDORS", "/nowhere")
    monkeypatch.setenv("POCL_CACHE_DIR", "/somewhere/ltcl-abc")  # our own
    monkeypatch.delenv("OCL_ICD_FILENAMES", raising=False)
    with pytest.raises(
        DeviceError, match="found with OCL_ICD_VENDORS=/nowhere; unset that, or install a driver"
    ):
        discovery.choose([], None)


def test_simulator_is_never_taken_unasked():
    with pytest.raises(DeviceError, match=r"only a simulator was found; name it \(Oclgrind Simulator\)"):
        discovery.choose([SIMULATOR], None)


def test_environment_names_the_default(device, monkeypatch):
    monkeypatch.setenv("LTCL_DEVICE", device.description.index)
    assert ltcl.open_device() is device
    assert ltcl.open_device("") is device
    monkeypatch.setenv("LTCL_DEVICE", "no such device")
    with pytest.raises(DeviceError, match="device is 'no such device'"):
        ltcl.open_device()
    assert ltcl.open_device(device.description.index) is device  # an argument overrides it


def test_a_device_is_opened_once(device):
    assert ltcl.open_device(device) is device
    assert ltcl.open_device(device.description.index) is device
    assert device.description in ltcl.list_devices()


def test_other_types_are_refused():
    with pytest.raises(InputTypeError, match="device is 0; it must be a Device, a name or an index"):
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
