# SPDX-License-Identifier: BSD-3-Clause
"""What `ltcl demo` prints; what the demo computes is the matter of tests/test_demo.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ltcl import demo
from ltcl.device import Device

from .conftest import Outcome, Program


@pytest.fixture(scope="module")
def done(device: Device, tmp_path_factory: pytest.TempPathFactory) -> demo.Demo:
    return demo.run(tmp_path_factory.mktemp("demo") / "out", size=6, device=device)


def run(program: Program, monkeypatch: pytest.MonkeyPatch, done: demo.Demo, *options: str) -> Outcome:
    """The command, with the demo already done."""

    def instead(out: Path, size: int, *, device: Any, progress: Any) -> demo.Demo:
        assert (out, size) == (done.folder, 6)
        for step in demo.STEPS:
            progress(step)
        return done

    monkeypatch.setattr(demo, "run", instead)
    return program("demo", "--out", done.folder, "--size", "6", *options)


def test_json(program: Program, monkeypatch: pytest.MonkeyPatch, done: demo.Demo) -> None:
    outcome = run(program, monkeypatch, done, "--json")
    assert outcome.code == 0
    assert outcome.json["errors"] == done.report["errors"]
    assert outcome.err.splitlines() == [f"ltcl: {k}/7 {step}" for k, step in enumerate(demo.STEPS, 1)]
    assert all((Path(outcome.json["folder"]) / name).is_file() for name in outcome.json["files"])


def test_tables_say_what_was_reached_and_where_to_look(
    program: Program, monkeypatch: pytest.MonkeyPatch, done: demo.Demo
) -> None:
    outcome = run(program, monkeypatch, done)
    assert outcome.code == 0
    assert f"{100 * done.report['errors']['compensated']:.1f} %" in outcome.out
    assert "diverged" in outcome.out
    assert str(done.folder / "contact_sheet.png") in outcome.out


def test_bad_device_is_refused_before_anything_is_made(
    program: Program, device: Device, tmp_path: Path
) -> None:
    program("demo", "--out", tmp_path / "out", "--device", "nonsense").refused("device is 'nonsense'")
    assert list(tmp_path.iterdir()) == []
