# SPDX-License-Identifier: BSD-3-Clause
"""The frame of every command: shared options, results, notes, errors in one line, exit codes.

Results are on stdout, as tables or as one JSON document; notes, warnings, errors and progress are
on stderr.
"""

from __future__ import annotations

import functools
import inspect
import logging
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from typer.models import ArgumentInfo

from ltcl.cli import interrupt
from ltcl.cli.progress import Progress
from ltcl.cli.reports.parts import ErrorReport
from ltcl.cli.reports.report import document
from ltcl.cli.streams import print_line, print_result
from ltcl.errors import FileError, LtclError
from ltcl.tasks import report

FAILED = 1
USAGE = 2
WAITING = 3
INTERNAL = 70
INTERRUPTED = 130
EXIT_CODES = (
    "**Exit codes:** 0 done; 1 refused or failed, with one line that tells "
    "why; 2 wrong usage; 3 'ltcl acquire run', or 'update', waits for photographs "
    "that a person has to take; 70 an error in ltcl itself; 130 Ctrl-C.\n\n"
    "With **--json** stdout holds one JSON document, also if a command fails: "
    '{"error": the problem, "type": its class in ltcl.errors, '
    '"exit_code": as above}. docs/reference/json.md has all fields.'
)
# Level of a note, between INFO and WARNING.
NOTE = 25
SHARED_PANEL = "Options of every command"
_logger = logging.getLogger(__name__)
# Typer exports only classes derived from this one.
UsageError: Any = typer.BadParameter.__base__


@dataclass(frozen=True, kw_only=True)
class Context:
    """A running command: its name, its options by name, its progress, and if it prints JSON."""

    name: str
    options: dict[str, Any]
    progress: Progress
    json: bool = False


@dataclass(frozen=True)
class Answer:
    """Result of a command: reports for --json, and the same as lines of text."""

    data: Any
    lines: Sequence[str | None]
    exit_code: int = 0


def _shared_options(
    json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print one JSON document on stdout, also for an error.",
            rich_help_panel=SHARED_PANEL,
        ),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            help="Print no progress, notes or warnings.",
            rich_help_panel=SHARED_PANEL,
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Print each step, too.", rich_help_panel=SHARED_PANEL),
    ] = False,
) -> None:
    """Options of every command."""


def command(*groups: Callable[..., None]) -> Callable[[Callable[..., Answer]], Callable[..., None]]:
    """Make a typer command of a function of a `Context` and the command's own arguments.

    A group is a function whose parameters are options, too; they are in `Context.options` only.
    """

    def decorate(function: Callable[..., Answer]) -> Callable[..., None]:
        own_parameters = _parameters(function)[1:]
        parameters = [*own_parameters]
        for group in (*groups, _shared_options):
            parameters += _parameters(group)
        own_names = [parameter.name for parameter in own_parameters]
        option_names = [p.name for p in parameters if not _is_argument(p)]

        @functools.wraps(function)
        def run(json: bool, quiet: bool, verbose: bool, **values: Any) -> None:
            options = {name: values[name] for name in option_names if name in values}
            own_values = {name: values[name] for name in own_names}
            with _log_to_stderr(quiet, verbose):
                try:
                    with interrupt.raised(), Progress(quiet) as progress:
                        context = Context(
                            name=function.__name__,
                            options=options,
                            progress=progress,
                            json=json,
                        )
                        answer = function(context, **own_values)
                    _print_answer(answer, json)
                    code = answer.exit_code
                except BrokenPipeError:
                    # Nobody reads stdout any more: typer ends the program quietly.
                    raise
                except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001
                    # Every error becomes a line and an exit code.
                    code = fail(error, json, verbose).exit_code
            raise typer.Exit(code)

        typed_run: Any = run
        typed_run.__signature__ = inspect.Signature(parameters)
        typed_run.__annotations__ = {p.name: p.annotation for p in parameters}
        return run

    return decorate


def _parameters(function: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return all parameters as ones that are passed by keyword."""
    signature = inspect.signature(function, eval_str=True)
    keyword = inspect.Parameter.KEYWORD_ONLY
    return [parameter.replace(kind=keyword) for parameter in signature.parameters.values()]


def _is_argument(parameter: inspect.Parameter) -> bool:
    return isinstance(parameter.annotation.__metadata__[0], ArgumentInfo)


def _print_answer(answer: Answer, json: bool) -> None:
    if json:
        print_result(report.dumps(document(answer.data)))
        return
    for line in answer.lines:
        if line is not None:
            print_result(line)


def fail(error: BaseException, json: bool = False, verbose: bool = False) -> ErrorReport:
    """Print an error as one line on stderr, and as JSON on stdout if asked; return its report."""
    kind = type(error).__name__
    message = " ".join(str(error).split())
    code = FAILED
    if isinstance(error, KeyboardInterrupt):
        code = INTERRUPTED
        if not message:
            message = "interrupted"
    elif isinstance(error, UsageError):
        code = USAGE
    elif isinstance(error, MemoryError) and not isinstance(error, LtclError):
        message = "the host has no memory left"
    elif not isinstance(error, LtclError):
        code = INTERNAL
        message = f"internal error: {kind}: {message}; --verbose prints where it occurred"
        if verbose:
            print_line("".join(traceback.format_exception(error)))
    print_line(f"ltcl: error: {message}")
    failure = ErrorReport(error=message, type=kind, exit_code=code)
    if json:
        with suppress(FileError):
            print_result(report.dumps(failure.document()))
    return failure


def note(text: str) -> None:
    """Print a line on stderr, unless ``--quiet``."""
    _logger.log(NOTE, "%s", text)


class _StderrHandler(logging.Handler):
    """Prints records of ltcl as lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        level = ""
        if record.levelno >= logging.WARNING:
            level = f"{record.levelname.lower()}: "
        message = " ".join(record.getMessage().split())
        print_line(f"ltcl: {level}{message}")


@contextmanager
def _log_to_stderr(quiet: bool, verbose: bool) -> Iterator[None]:
    """Show warnings and notes; only errors if `quiet`, also each step if `verbose`."""
    level = NOTE
    if quiet:
        level = logging.ERROR
    elif verbose:
        level = logging.INFO
    logger = logging.getLogger("ltcl")
    level_before = logger.level
    handler = _StderrHandler()
    logger.addHandler(handler)
    logger.setLevel(level)
    try:
        yield
    finally:
        logger.setLevel(level_before)
        logger.removeHandler(handler)
