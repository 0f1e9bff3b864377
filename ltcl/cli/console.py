# SPDX-License-Identifier: BSD-3-Clause
"""What people and programs get to read: tables or one JSON document on stdout, progress on stderr."""

from __future__ import annotations

import logging
import math
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from ltcl import report

_GAP = "   "  # between columns
_PATIENCE = 2.0  # seconds without a terminal before progress is worth a line
_AGAIN = 10.0  # and before the next line on many frames
_OFTEN = 1.0  # seconds between lines of a long solve


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
    seconds, then also for what has begun before, and one about every second of a long solve.

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
        self._name, self._doing, self._said = "", "", 0.0
        self._quiet_until = time.monotonic() + _PATIENCE if patient else 0.0
        self._overdue = threading.Timer(_PATIENCE, self._say_what_began)
        self._overdue.daemon = True
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
        elif time.monotonic() < self._quiet_until:
            self._overdue.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._overdue.cancel()
        if self._is_terminal:
            self._bar.stop()

    def item(self, name: str) -> None:
        """Begin the next item."""
        self._item, self._solve = self._item + 1, 0
        counted = f"{self._item}/{self._items} {name}" if self._items > 1 else name
        done = (self._item - 1) * self._solves
        self._bar.update(self._task, description=counted, completed=done, text="")
        self._name, self._doing = counted, ""
        self._say(counted, 0.0)

    def at(self, text: str, share: float) -> None:
        """A `progress` for this item: what is being done, and the share that is."""
        if text != self._doing:
            self._doing = text
            self._say(text, 0.0)
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
            self._say(f"{self._name}: {text}", _OFTEN)

        return step

    def _say_what_began(self) -> None:
        """A line for what began too early for one."""
        if (text := self._doing or self._name) and not self._said:
            self._say(text, 0.0)

    def _say(self, text: str, again: float) -> None:
        """A line, unless it is too early for any, or less than `again` seconds after the last."""
        now = time.monotonic()
        if not self._is_terminal and now >= max(self._quiet_until, self._said + again):
            note(text)
            self._said = now


class Frames:
    """Progress through many frames, on stderr: a `progress` for `ltcl.batch.compensate_frames`.

    On a terminal a bar with frames a second and the time left; elsewhere the same as a line now and then. The
    first call tells how many were done before.

    Parameters
    ----------
    what : str
        The name of the things that are counted, if not frames.
    settling : float
        Seconds within which all that is done was done before: earlier runs are told piece by piece.
    """

    def __init__(self, what: str = "frames", settling: float = 0.0) -> None:
        console = Console(stderr=True)
        self.done = 0
        self._what, self._settling = what, settling
        self._is_terminal = console.is_terminal
        self._before, self._begun, self._first, self._said = 0, 0.0, 0.0, 0.0
        self._heard: float | None = None
        columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[text]}"))
        self._bar = Progress(*columns, console=console, transient=True, disable=not self._is_terminal)
        self._task = self._bar.add_task("", total=None, text="")

    def __enter__(self) -> Frames:
        if self._is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._is_terminal:
            self._bar.stop()

    def at(self, text: str) -> None:
        """Say what is being done before there is anything to count."""
        self._bar.update(self._task, text=text)
        now = time.monotonic()
        self._heard = now if self._heard is None else self._heard
        if not self._is_terminal and now >= self._heard + _PATIENCE:
            note(text)

    def __call__(self, done: int, total: int | None) -> None:
        """Note that so many frames are done."""
        now = time.monotonic()
        if not self._begun:
            self._before, self._begun, self._first = done, now, now
            self._said = now + _PATIENCE - _AGAIN
        elif now < self._first + self._settling:
            self._before, self._begun = done, now
        self.done = done
        text = _pace(done - self._before, now - self._begun, None if total is None else total - done)
        self._bar.update(self._task, completed=done, total=total, text=text)
        if not self._is_terminal and now >= self._said + _AGAIN:
            self._said = now
            note(f"{done}{'' if total is None else f' of {total}'} {self._what}, {text}".rstrip(", "))


@contextmanager
def hearing(name: str, tell: Callable[[str], None]) -> Iterator[None]:
    """What the part `name` of the library logs of its progress is told."""
    logger, handler = logging.getLogger(name), _Heard(tell)
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)


class _Heard(logging.Handler):
    def __init__(self, tell: Callable[[str], None]) -> None:
        super().__init__(logging.INFO)
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO:  # warnings are said anyway
            self._tell(record.getMessage())


def _pace(done: int, seconds: float, left: int | None) -> str:
    """Frames a second, and the time for those that are left.

    >>> _pace(30, 10.0, 200), _pace(0, 0.0, 5), _pace(1, 20.0, None)
    ('3.0 a second, 0:01:06 left', '', '0.05 a second')
    """
    if not done or seconds <= 0:
        return ""
    rate = done / seconds
    shown = f"{rate:.1f} a second" if rate >= 1 else f"{rate:.2g} a second"
    return shown if left is None else f"{shown}, {timedelta(seconds=int(left / rate))} left"


def _gained(residual: float, rtol: float) -> float:
    """Share of the digits that a solve to `rtol` must gain; 0 for a residual that has grown."""
    if not 0 < rtol < 1 or not math.isfinite(residual):
        return 0.0
    return min(max(math.log(max(residual, 1e-30)) / math.log(rtol), 0.0), 1.0)
