# SPDX-License-Identifier: BSD-3-Clause
"""What people and programs get to read: tables or one JSON document on stdout, progress on stderr."""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ltcl import report

_GAP = "   "  # between columns
_PATIENCE = 2.0  # seconds without a terminal before progress is worth a line


def answer(value: Any) -> None:
    """Print the one JSON document of ``--json``."""
    typer.echo(report.dumps(value))


def note(text: str) -> None:
    """Say something on stderr."""
    typer.echo(f"ltcl: {text}", err=True)


def error(text: str) -> None:
    """Say on stderr, in one line, what was refused or failed."""
    typer.echo(f"ltcl: error: {' '.join(text.split())}", err=True)


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table on stdout; columns of numbers stand right.

    Nothing is broken: where a terminal is too narrow for the table, each row becomes a list of its own.
    """
    shown = [[_cell(value) for value in row] for row in rows]
    widths = [max(map(cell_len, (name, *values))) for name, *values in zip(columns, *shown, strict=True)]
    needed = sum(widths) + len(_GAP) * (len(columns) - 1)
    if not sys.stdout.isatty():
        console = Console(width=max(needed, 80))  # rich would assume 80 columns
    elif needed > (console := Console()).width:
        _list(columns, shown)
        return
    frame = Table(box=None, pad_edge=False, padding=(0, len(_GAP), 0, 0), header_style="bold")
    for name, values in zip(columns, zip(*shown, strict=True), strict=False):
        right = all(_is_number(value) for value in values)
        frame.add_column(name, justify="right" if right else "left", no_wrap=True)
    for row in shown:
        frame.add_row(*(Text(value) for value in row))
    console.print(frame)


def _list(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """A line a cell, its column's name in front; an empty line between rows."""
    width = max(map(cell_len, columns))
    blocks = [
        "\n".join(f"{name:<{width}}{_GAP}{value}".rstrip() for name, value in zip(columns, row, strict=True))
        for row in rows
    ]
    typer.echo("\n\n".join(blocks))


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "diverges" if value > 0 else "-"
    return str(value)


def _is_number(text: str) -> bool:
    return text in ("-", "diverges") or re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?( %)?", text) is not None


class Steps:
    """Progress through several items and the solves in each, on stderr.

    On a terminal a bar; elsewhere a line an item, by default once the whole has taken longer than two
    seconds.

    Parameters
    ----------
    items : int
    solves : int
        Of each item, for the length of the bar.
    patient : bool
        Say nothing in the first two seconds; otherwise every item gets its line.
    """

    def __init__(self, items: int, solves: int = 1, *, patient: bool = True) -> None:
        self._items, self._solves = items, solves
        self._item = self._solve = 0
        self._doing = ""
        self._quiet_until = time.monotonic() + _PATIENCE if patient else 0.0
        console = Console(stderr=True)
        self._is_terminal = console.is_terminal
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[text]}"),
        )
        self._bar = Progress(*columns, console=console, transient=True, disable=not self._is_terminal)
        self._task = self._bar.add_task("", total=items * solves, text="")

    def __enter__(self) -> Steps:
        if self._is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_terminal:
            self._bar.stop()

    def item(self, name: str) -> None:
        """Begin the next item."""
        self._item, self._solve = self._item + 1, 0
        counted = f"{self._item}/{self._items} {name}" if self._items > 1 else name
        done = (self._item - 1) * self._solves
        self._bar.update(self._task, description=counted, completed=done, text="")
        if not self._is_terminal and time.monotonic() >= self._quiet_until:
            note(counted)

    def at(self, text: str, share: float) -> None:
        """A `progress` for this item: what is being done, and the share that is."""
        if text != self._doing and not self._is_terminal and time.monotonic() >= self._quiet_until:
            note(text)
        self._doing = text
        self._bar.update(self._task, completed=(self._item - 1 + share) * self._solves, text=text)

    def solve(self, rtol: float) -> Callable[[int, float], None]:
        """A `callback` for the solves of this item: moves the bar by the digits gained."""

        def step(iteration: int, residual: float) -> None:
            self._solve += iteration == 0
            done = (self._item - 1) * self._solves + min(
                self._solve - 1 + _gained(residual, rtol), self._solves
            )
            text = f"sampling, step {iteration}" if math.isnan(residual) else f"residual {residual:.1e}"
            self._bar.update(self._task, completed=done, text=text)

        return step


def _gained(residual: float, rtol: float) -> float:
    """Share of the digits that a solve to `rtol` must gain; 0 for a residual that has grown."""
    if not 0 < rtol < 1 or not math.isfinite(residual):
        return 0.0
    return min(max(math.log(max(residual, 1e-30)) / math.log(rtol), 0.0), 1.0)
