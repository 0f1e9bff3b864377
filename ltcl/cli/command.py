# SPDX-License-Identifier: BSD-3-Clause
"""The frame of every command: shared options, results, notes.

Results are on stdout, as tables or as one JSON document; notes, warnings, errors and progress are
on stderr.
"""

from __future__ import annotations

import functools
import inspect
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from typer.models import ArgumentInfo

from ltcl.cli import interrupt
from ltcl.cli.failure import fail
from ltcl.cli.progress import Progress
from ltcl.cli.reports.report import document
from ltcl.cli.streams import print_line, print_result
from ltcl.tasks import report

# Level of a note, between INFO and WARNING.
NOTE = 25
SHARED_PANEL = "Options of every command"
_logger = logging.getLogger(__name__)


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
    parameters = []
    for parameter in signature.parameters.values():
        if parameter.annotation is not Context:
            _name_value(parameter)
        parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
    return parameters


def _name_value(parameter: inspect.Parameter) -> None:
    """Let the help show what a value is: N for integers, and else RTOL for --rtol."""
    declared = parameter.annotation.__metadata__[0]
    kind = str(parameter.annotation.__origin__)
    if declared.metavar is not None or "Literal[" in kind:
        return
    declared.metavar = parameter.name.upper()
    if re.search(r"\bint\b", kind):
        declared.metavar = "N"
    elif re.search(r"\bbool\b", kind):
        # A flag has no value.
        declared.metavar = ""


def _is_argument(parameter: inspect.Parameter) -> bool:
    return isinstance(parameter.annotation.__metadata__[0], ArgumentInfo)


def _print_answer(answer: Answer, json: bool) -> None:
    if json:
        print_result(report.dumps(document(answer.data)))
        return
    for line in answer.lines:
        if line is not None:
            print_result(line)


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
