# SPDX-License-Identifier: BSD-3-Clause
"""Tables and progress as people see them."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest

from ltcl.cli import console


def test_a_table_shows_names_as_they_are_and_numbers_right(capsys):
    name = "a/[bold]very" + 40 * "y" + " long[/bold] name.npz"
    console.table(("file", "rho", "n"), [(name, 0.123456, 5), ("b", None, 123), ("c", float("inf"), 7)])
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines[1].startswith(name)
    assert [line.split()[-2] for line in lines] == ["rho", "0.1235", "-", "diverges"]
    assert [line[-3:] for line in lines] == ["  n", "  5", "123", "  7"]


def test_answer_is_strict_json(capsys):
    console.answer({"rho": np.float32(0.5), "products": float("inf"), "name": "Größe"})
    assert json.loads(capsys.readouterr().out) == {"rho": 0.5, "products": None, "name": "Größe"}


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")


@pytest.mark.usefixtures("terminal")
def test_progress_is_a_bar_with_elapsed_time_and_time_left(capsys):
    with console.Progress() as progress:
        progress("reading")
        progress("frames", 8, 32)
        progress("frames", 16, 32)
        progress._bar.refresh()
    out, err = capsys.readouterr()
    assert out == ""
    assert progress.done == 16
    assert "frames" in err
    assert "0:00:0" in err
    assert "left" in err


@pytest.mark.parametrize("quiet", [True, False])
def test_without_a_terminal_and_if_quiet_there_is_none(capsys, monkeypatch, quiet):
    if quiet:
        monkeypatch.setenv("FORCE_COLOR", "1")
    with console.Progress(quiet) as progress:
        progress("frames", 8, 32)
    assert capsys.readouterr() == ("", "")


def test_if_verbose_each_step_is_one_line(capsys):
    with console.logging_to_stderr(quiet=False, verbose=True), console.Progress() as progress:
        for name in progress.each(["a.png", "b.png"]):
            progress("solving", 0, 2)
            progress("solving", len(name) / 5, 2)
    logging.getLogger("ltcl").info("afterwards")
    assert capsys.readouterr().err == "ltcl: 1/2 a.png: solving\nltcl: 2/2 b.png: solving\n"


def test_solves_count_the_digits_gained():
    progress, done = console.Progress(), []
    callback = progress.solve(1e-2, 2)
    for iteration, residual in [
        (0, 1.0),
        (1, 0.1),
        (2, 1e-3),
        (0, 1.0),
        (1, float("nan")),
        (2, 1e-3),
        (0, 9.0),
    ]:
        callback(iteration, residual)
        done.append(progress.done)
    assert done == pytest.approx([0, 0.5, 1, 1, 1, 2, 2])
