# SPDX-License-Identifier: BSD-3-Clause
"""What all commands share: --json, --quiet, --verbose, progress, tables, errors in one line, exit codes.

Results are on stdout, tables for people or one JSON document; notes, warnings, errors, progress on
stderr.
"""

from __future__ import annotations

import functools
import inspect
import logging
import math
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

import rich.progress
import typer
from rich.cells import cell_len
from rich.console import Console
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from typer.models import ArgumentInfo

from ltcl.errors import LtclError
from ltcl.tasks import report

FAILED, USAGE, WAITING, INTERNAL, INTERRUPTED = 1, 2, 3, 70, 130
EXIT_CODES = (
    "**Exit codes:** 0 done; 1 refused or failed, said in one line; 2 wrong usage; 3 'ltcl acquire run' "
    "waits for photographs that a person has to take; 70 an error in ltcl itself; 130 Ctrl-C.\n\n"
    'With **--json** stdout holds one JSON document, also of a command that fails: {"error": what is wrong, '
    '"type": its class in ltcl.errors, "exit_code": as above}. docs/reference/json.md has all fields.'
)
_NOTE = 25  # level of a note, between INFO and WARNING
_PERIOD = 300.0  # seconds of the past from which the time left is estimated
_logger = logging.getLogger(__name__)
UsageError: Any = typer.BadParameter.__base__  # typer exports those below it only


@dataclass(frozen=True)
class Context:
    """Of a command that runs: its name, its options by name, and its progress."""

    name: str
    options: dict[str, Any]
    progress: Progress


@dataclass(frozen=True)
class Answer:
    """Result of a command: `data` for --json; `lines` are the same for people."""

    data: Any
    lines: Sequence[str | None]
    exit_code: int = 0


def _shared(
    json: Annotated[
        bool, typer.Option("--json", help="One JSON document on stdout, or an error's.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="No progress, notes or warnings.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Also say what is being done.")
    ] = False,
) -> None:
    """The options of every command."""


def command(*groups: Callable[..., None]) -> Callable[[Callable[..., Answer]], Callable[..., None]]:
    """A function of a `Context` and its own arguments as a command of typer.

    A group is a function whose parameters are options, too; they are in `Context.options` only.
    """

    def decorate(function: Callable[..., Answer]) -> Callable[..., None]:
        signatures = [
            inspect.signature(each, eval_str=True) for each in (function, *groups, _shared)
        ]
        every = [
            parameter for signature in signatures for parameter in signature.parameters.values()
        ]
        parameters = [
            parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in every[1:]
        ]
        positional = {
            p.name for p in parameters if isinstance(p.annotation.__metadata__[0], ArgumentInfo)
        }
        own = [*signatures[0].parameters][1:]

        @functools.wraps(function)
        def run(json: bool, quiet: bool, verbose: bool, **values: Any) -> None:
            options = {name: value for name, value in values.items() if name not in positional}
            with _log_to_stderr(quiet, verbose):
                try:
                    with Progress(quiet) as progress:
                        context = Context(function.__name__, options, progress)
                        answer = function(context, **{name: values[name] for name in own})
                    for line in [report.dumps(answer.data)] if json else answer.lines:
                        if line is not None:
                            typer.echo(line)
                    code = answer.exit_code
                except BrokenPipeError:  # nobody reads stdout any more: typer ends quietly
                    raise
                except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - each becomes a line and a code
                    code = fail(error, json, verbose)["exit_code"]
            raise typer.Exit(code)

        vars(run)["__signature__"] = inspect.Signature(parameters)
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        return run

    return decorate


def fail(error: BaseException, json: bool = False, verbose: bool = False) -> dict[str, Any]:
    """Print an error as one line on stderr, and as JSON on stdout: message, type and exit code, returned."""
    code, kind, message = FAILED, type(error).__name__, " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt):
        code, message = INTERRUPTED, message or "interrupted"
    elif isinstance(error, UsageError):
        code = USAGE
    elif isinstance(error, MemoryError) and not isinstance(error, LtclError):
        message = "the host has no memory left"
    elif not isinstance(error, LtclError):
        code, message = (
            INTERNAL,
            f"internal error: {kind}: {message}; --verbose prints where it occurred",
        )
        if verbose:
            typer.echo("".join(traceback.format_exception(error)), err=True)
    typer.echo(f"ltcl: error: {message}", err=True)
    document = {"error": message, "type": kind, "exit_code": code}
    if json:
        typer.echo(report.dumps(document))
    return document


def note(text: str) -> None:
    """Print a line on stderr, unless ``--quiet``."""
    _logger.log(_NOTE, "%s", text)


@contextmanager
def _log_to_stderr(quiet: bool, verbose: bool) -> Iterator[None]:
    """Show warnings and notes of ltcl; errors only if `quiet`, and what it is doing if `verbose`."""

    def show(record: logging.LogRecord) -> None:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        typer.echo(f"ltcl: {level}{' '.join(record.getMessage().split())}", err=True)

    logger, handler = logging.getLogger("ltcl"), logging.Handler()
    before, handler.emit = logger.level, show
    logger.addHandler(handler)
    logger.setLevel(logging.ERROR if quiet else logging.INFO if verbose else _NOTE)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.removeHandler(handler)


def table(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table, numbers right-aligned; nothing is cut off in a narrow terminal."""
    aligned = []
    for name, *values in zip(
        columns, *([_cell(value) for value in row] for row in rows), strict=True
    ):
        right = all(value[:1] in "+-.0123456789" or value == "diverges" for value in values)
        width = max(map(cell_len, (name, *values)))
        padded = ((text, " " * (width - cell_len(text))) for text in (name, *values))
        aligned.append([gap + text if right else text + gap for text, gap in padded])
    return "\n".join("   ".join(row).rstrip() for row in zip(*aligned, strict=True))


def _cell(value: Any) -> str:
    if isinstance(value, float) and math.isfinite(value):
        return f"{value:.4g}"
    unknown = value is None or (isinstance(value, float) and not value > 0)
    return "-" if unknown else "diverges" if isinstance(value, float) else str(value)


def percent(share: float | None, digits: int = 3) -> str | None:
    """A share in percent, as a cell of a table."""
    return None if share is None else f"{100 * share:.{digits}g} %"


class Progress(rich.progress.Progress):
    """`progress(step, done, total)`: a bar on stderr with elapsed time and time left, on a terminal only.

    It runs from the start of a command to its end; without a total it shows that something is
    running.
    """

    def __init__(self, quiet: bool = False) -> None:
        console = Console(stderr=True)
        hidden = quiet or not console.is_terminal
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
        )
        times = TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("left")
        super().__init__(
            *columns,
            *times,
            console=console,
            transient=True,
            disable=hidden,
            speed_estimate_period=_PERIOD,
        )
        self._item = self._step = ""
        self._solves = 0  # of this item that have begun
        self.add_task("", total=None)

    def __call__(
        self, step: str, done: float = 0, total: float | None = None, *, detail: str = ""
    ) -> None:
        """Show what is being done and how much of it is done."""
        if step != self._step:
            _logger.info("%s%s", self._item, step)
        (task,), self._step = self.tasks, step
        if (
            task.total != total or done < task.completed
        ):  # something else is counted, at another pace
            self.remove_task(task.id)
            self.add_task("", total=total)
        self.update(self.task_ids[0], description=f"{self._item}{step}{detail}", completed=done)

    def each(self, items: Sequence[Any]) -> Iterator[Any]:
        """All items, with their names before the steps that follow."""
        for number, item in enumerate(items, 1):
            count = f"{number}/{len(items)} " if len(items) > 1 else ""
            self._item, self._step, self._solves = f"{count}{item}: ", "", 0
            yield item
        self._item = ""

    def solve(self, rtol: float, solves: int) -> Callable[[int, float], None]:
        """A `callback(iteration, residual)`: digits gained towards `rtol` in so many solves of an item."""

        def callback(iteration: int, residual: float) -> None:
            self._solves += iteration == 0
            gained = (
                math.log(residual) / math.log(rtol) if 0 < residual < 1 and 0 < rtol < 1 else 0.0
            )
            shown = "" if math.isnan(residual) else f", relative residual {residual:.1e}"
            done = min(self._solves - 1 + min(gained, 1.0), solves)
            self("solving", done, solves, detail=f": iteration {iteration}{shown}")

        return callback
