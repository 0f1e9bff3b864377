# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import pytest

from ltcl.cli import devices
from ltcl.device import Device

from .conftest import Program


def test_table_marks_the_device_that_would_be_chosen(program: Program, device: Device) -> None:
    outcome = program("devices")
    assert outcome.code == 0
    (marked,) = [line for line in outcome.out.splitlines() if line.startswith("->")]
    assert device.description.index in marked
    assert device.name in marked


def test_json(program: Program, device: Device) -> None:
    entries = program("devices", "--json").json
    (chosen,) = [entry for entry in entries if entry["chosen"]]
    assert chosen["name"] == device.name
    assert chosen["compute_units"] >= 1
    assert chosen["max_allocation"] > 0


def test_unknown_ltcl_device_still_lists_those_there_are(
    program: Program, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")
    outcome = program("devices")
    assert outcome.code == 0
    assert device.name in outcome.out
    assert "->" not in outcome.out
    assert outcome.err == "ltcl: LTCL_DEVICE=nonsense matches none of these\n"
    assert not any(entry["chosen"] for entry in program("devices", "--json").json)


def test_without_devices_the_fix_is_told(program: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices.discovery, "list_devices", list)
    program("devices").refused("no OpenCL device", "install")
