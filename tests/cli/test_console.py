# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import json
import logging
import time

import numpy as np
import pytest

from ltcl.cli import console, options


def test_table_shows_names_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    name = "a/[bold]very" + 40 * "y" + " long[/bold] name.npz"
    console.table(("file", "rho"), [(name, 0.123456), ("b", None), ("c", float("inf"))])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith(name)
    assert [line.split()[-1] for line in lines] == ["rho", "0.1235", "-", "diverges"]


def test_numbers_stand_right_and_words_left(capsys: pytest.CaptureFixture[str]) -> None:
    console.table(("n", "word"), [(5, "a"), (123, "bcd")])
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "  n   word",
        "  5   a",
        "123   bcd",
    ]


def test_a_narrow_terminal_breaks_no_number(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console.sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    name = "folder/" * 9 + "name.npz"
    console.table(("file", "rho"), [("a.npz", 0.123456), (name, 7)])
    assert len(capsys.readouterr().out.splitlines()) == 3
    console.table(("file", "first number"), [("a.npz", 0.123456), (name, 7)])
    assert capsys.readouterr().out == (
        f"file           a.npz\nfirst number   0.1235\n\nfile           {name}\nfirst number   7\n"
    )


def test_answer_is_strict_json(capsys: pytest.CaptureFixture[str]) -> None:
    console.answer({"rho": np.float32(0.5), "products": float("inf"), "name": "Größe"})
    out = capsys.readouterr().out
    assert json.loads(out) == {"rho": 0.5, "products": None, "name": "Größe"}
    assert "Größe" in out


def test_without_a_terminal_short_runs_are_silent(capsys: pytest.CaptureFixture[str]) -> None:
    with console.Steps(2) as steps:
        steps.item("a.png")
        steps.item("b.png")
    assert capsys.readouterr() == ("", "")


def test_without_a_terminal_long_runs_say_where_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_PATIENCE", -1.0)
    with console.Steps(2) as steps:
        steps.item("a.png")
        steps.item("b.png")
    assert capsys.readouterr().err == "ltcl: 1/2 a.png\nltcl: 2/2 b.png\n"


def test_what_began_at_once_and_takes_long_is_announced(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_PATIENCE", 0.05)
    with console.Steps(1) as steps:
        steps.item("a.png")
        steps.at("trying db2", 0.0)
        time.sleep(0.5)
    assert capsys.readouterr().err == "ltcl: trying db2\n"


def test_what_earlier_runs_have_done_is_no_pace(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0, 0.5, 10.0, 20.0])
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    progress = console.Frames("patterns", settling=1.0)
    for done in (100, 200, 210, 220):
        progress(done, 300)
    assert capsys.readouterr().err.splitlines() == [
        "ltcl: 210 of 300 patterns, 1.1 a second, 0:01:25 left",
        "ltcl: 220 of 300 patterns, 1.0 a second, 0:01:18 left",
    ]


def test_stages_are_told_and_warnings_are_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_PATIENCE", -1.0)
    logger = logging.getLogger("ltcl.acquisition.run")
    with console.Frames("patterns") as progress, console.hearing("ltcl.acquisition", progress.at):
        logger.info("calibration: %s", "noise")
        logger.warning("a warning")
    logger.info("afterwards")
    lines = capsys.readouterr().err.splitlines()
    assert "ltcl: calibration: noise" in lines
    assert not any("afterwards" in line or line == "ltcl: a warning" for line in lines)


def test_bar_follows_the_digits_gained() -> None:
    steps = console.Steps(items=2, solves=2)
    (task,) = steps._bar.tasks
    steps.item("a.png")
    seen = []
    for _ in range(2):
        callback = steps.solve(1e-2)
        for iteration, residual in enumerate((1.0, 0.1, 1e-3)):
            callback(iteration, residual)
            seen.append(task.completed)
    assert seen == pytest.approx([0, 0.5, 1, 1, 1.5, 2])
    steps.item("b.png")
    steps.solve(1e-2)(0, float("nan"))
    assert task.completed == 2


def test_bar_tells_the_steps_of_a_method_that_samples() -> None:
    steps = console.Steps(items=1)
    (task,) = steps._bar.tasks
    steps.item("a.png")
    callback = steps.solve(1e-2)
    callback(0, 1.0)
    callback(1, float("nan"))
    assert (task.completed, task.fields["text"]) == (0, "sampling, step 1")
    callback(1, 1e-3)
    assert (task.completed, task.fields["text"]) == (1, "residual 1.0e-03")


def test_bar_is_full_when_three_channels_that_were_sampled_at_once_are_done() -> None:
    steps = console.Steps(items=2, solves=options.solves("monte_carlo", 3))
    (task,) = steps._bar.tasks
    steps.item("a.png")
    callback = steps.solve(1e-2)
    for number, residual in enumerate((1.0, 1.0, 1.0, float("nan"), 1e-3, 1e-3, 1e-3)):
        callback(number, residual)
        assert task.completed == (number > 3)


def test_frames_on_a_terminal_are_a_bar_with_rate_and_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "100")
    with console.Frames() as progress:
        progress(8, 32)
        progress(16, 32)
        progress._bar.refresh()
    out, err = capsys.readouterr()
    assert out == ""
    assert progress.done == 16
    assert "16/32" in err
    assert " a second, " in err
    assert " left" in err


def test_frames_of_unknown_number(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "_PATIENCE", 0.0)
    monkeypatch.setattr(console, "_AGAIN", 0.0)
    clock = iter([1.0, 2.0])
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with console.Frames() as progress:
        progress(0, None)
        progress(3, None)
    assert capsys.readouterr().err.splitlines() == ["ltcl: 0 frames", "ltcl: 3 frames, 3.0 a second"]


def test_without_a_terminal_long_solves_say_how_far_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with console.Steps(1) as steps:
        steps.item("a.png")
        step = steps.solve(1e-2)
        for iteration in range(80):
            step(iteration, float("nan"))
            clock[0] += 0.125
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "ltcl: a.png: sampling, step 16"
    assert lines[1:] == [f"ltcl: a.png: sampling, step {n}" for n in range(24, 80, 8)]
