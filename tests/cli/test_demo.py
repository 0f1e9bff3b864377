# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

from ltcl.device import Device

from .conftest import Program


def test_json(program: Program, device: Device, tmp_path: Path) -> None:
    outcome = program("demo", "--out", tmp_path / "out", "--size", "6", "--json")
    assert outcome.code == 0, outcome.err
    report = outcome.json
    assert report["errors"]["compensated"] < 0.02
    assert all((tmp_path / "out" / name).is_file() for name in report["files"])


def test_table_says_where_to_look(program: Program, device: Device, tmp_path: Path) -> None:
    outcome = program("demo", "--out", tmp_path / "out", "--size", "6")
    assert outcome.code == 0
    assert "contact_sheet.png" in outcome.out
    assert "compensated" in outcome.out


def test_bad_device_is_refused_before_anything_is_made(
    program: Program, device: Device, tmp_path: Path
) -> None:
    program("demo", "--out", tmp_path / "out", "--device", "nonsense").refused("device is 'nonsense'")
    assert list(tmp_path.iterdir()) == []
