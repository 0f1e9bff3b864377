# SPDX-License-Identifier: BSD-3-Clause
"""Tables or one JSON document on stdout; notes, warnings, errors and progress on stderr."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import typer
from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.table import Table
from rich.text import Text

from ltcl import report

_GAP = "   "  # between columns
_NOTE = 25  # level of a note, between INFO and WARNING
_PERIOD = 300.0  # seconds of the past from which the time left is estimated
_logger = logging.getLogger(__name__)


def answer(value: Any) -> None:
    """Print the JSON document of ``--json``."""
    typer.echo(report.dumps(value))


def note(text: str) -> None:
    """Print a line on stderr, unless ``--quiet``."""
    _logger.log(_NOTE, "%s", text)


def error(text: str) -> None:
    """Print on stderr, in one line, what was refused or failed."""
    typer.echo(f"ltcl: error: {' '.join(text.split())}", err=True)


class _Log(logging.Handler):
    """Messages of the library as lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        typer.echo(f"ltcl: {level}{' '.join(record.getMessage().split())}", err=True)


@contextmanager
def logging_to_stderr(quiet: bool, verbose: bool) -> Iterator[None]:
    """Show warnings and notes of ltcl; errors only if `quiet`, and what it is doing if `verbose`."""
    logger, handler = logging.getLogger("ltcl"), _Log()
    before, level = logger.level, logging.ERROR if quiet else logging.INFO if verbose else _NOTE
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table on stdout, numbers right-aligned; nothing is cut off in a narrow terminal."""
    cells = [[_cell(value) for value in row] for row in rows]
    frame = Table(box=None, pad_edge=False, padding=(0, len(_GAP), 0, 0), header_style="bold")
    needed = 0
    for name, *values in zip(columns, *cells, strict=True):
        right = all(re.fullmatch(r"-|diverges|[-+]?[\d.]+(e[-+]?\d+)?( %)?", value) for value in values)
        frame.add_column(name, justify="right" if right else "left", no_wrap=True)
        needed += max(map(cell_len, (name, *values))) + len(_GAP)
    for row in cells:
        frame.add_row(*map(Text, row))
    Console(width=max(needed, 80)).print(frame, soft_wrap=True)


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}" if math.isfinite(value) else "diverges" if value > 0 else "-"
    return str(value)


def percent(share: float | None, digits: int = 3) -> str | None:
    """A share in percent, as a cell of a table.

    >>> percent(0.12345), percent(None)
    ('12.3 %', None)
    """
    return None if share is None else f"{100 * share:.{digits}g} %"


class Progress:
    """`progress(step, done, total)`: a bar on stderr with elapsed time and time left, on a terminal only.

    It runs from the start of a command to its end; without a total it shows that something is running.
    """

    def __init__(self, quiet: bool = False) -> None:
        console = Console(stderr=True)
        self._bar = Bar(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
            speed_estimate_period=_PERIOD,
        )
        self._item = self._step = ""
        self.done: float = 0
        self._bar.add_task("", total=None, left="")

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, step: str, done: float = 0, total: float | None = None, *, detail: str = "") -> None:
        """Show what is being done and how much of it is done."""
        if step != self._step:
            _logger.info("%s%s", self._item, step)
        (task,), self._step, self.done = self._bar.tasks, step, done
        text, left = f"{self._item}{step}{detail}", "left" if total else ""
        if task.total == total and done >= task.completed:
            self._bar.update(task.id, description=text, completed=done)
        else:  # something else is counted: its pace is not that of the last step
            self._bar.remove_task(task.id)
            fields: Any = {"total": total, "completed": done, "left": left}  # rich says int
            self._bar.add_task(text, **fields)

    def share(self, step: str, share: float) -> None:
        """The same for what tells the share that is done."""
        self(step, share, 1.0)

    def each(self, items: Sequence[Any]) -> Iterator[Any]:
        """All items, with their names before the steps that follow."""
        for number, item in enumerate(items, 1):
            count = f"{number}/{len(items)} " if len(items) > 1 else ""
            self._item, self._step = f"{count}{item}: ", ""
            yield item
        self._item = ""

    def solve(self, rtol: float, solves: int) -> Callable[[int, float], None]:
        """A `callback(iteration, residual)` that shows the digits gained towards `rtol` in so many solves."""
        begun = 0

        def step(iteration: int, residual: float) -> None:
            nonlocal begun
            begun += iteration == 0
            done = min(begun - 1 + _digits_gained(residual, rtol), solves)
            residuals = "" if math.isnan(residual) else f", relative residual {residual:.1e}"
            self("solving", done, solves, detail=f": iteration {iteration}{residuals}")

        return step


def _digits_gained(residual: float, rtol: float) -> float:
    """Share of the digits that a solve to `rtol` must gain; 0 where the residual has grown."""
    if not 0 < rtol < 1 or not math.isfinite(residual):
        return 0.0
    return min(max(math.log(max(residual, 1e-30)) / math.log(rtol), 0.0), 1.0)
