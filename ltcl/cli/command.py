# SPDX-License-Identifier: BSD-3-Clause
"""`command`: what all commands share: --json, --quiet and --verbose, progress, errors and exit codes."""

from __future__ import annotations

import functools
import inspect
import re
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from typer.models import ArgumentInfo

from ltcl.cli import console
from ltcl.errors import LtclError

FAILED, USAGE, WAITING, INTERNAL, INTERRUPTED = 1, 2, 3, 70, 130
EXIT_CODES = (
    "**Exit codes:** 0 done; 1 refused or failed, said in one line; 2 wrong usage; 3 'ltcl acquire run' "
    "waits for photographs that a person has to take; 70 an error in ltcl itself; 130 Ctrl-C.\n\n"
    'With **--json** stdout holds one JSON document, also of a command that fails: {"error": what is wrong, '
    '"type": its class in ltcl.errors, "exit_code": as above}. docs/cli.md lists the fields of the others.'
)
_SEVERAL = {"bounds": ["low", "high"]}  # options that are one argument of the library


@dataclass(frozen=True)
class Context:
    """Of a command that runs: its name, its options by name, and its progress."""

    name: str
    options: dict[str, Any]
    progress: console.Progress


@dataclass(frozen=True)
class Answer:
    """What a command found out: `data` for --json, `show()` prints the same for people."""

    data: Any
    show: Callable[[], object]
    exit_code: int = 0


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, also of an error.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, notes or warnings on stderr.")]
Verbose = Annotated[bool, typer.Option("--verbose", help="Also say what is being done.")]


def _shared(json: Json = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """The options of every command."""


def command(function: Callable[..., Answer]) -> Callable[..., None]:
    """A function of a `Context` and its arguments as a command of typer."""
    own, shared = (inspect.signature(each, eval_str=True).parameters.values() for each in (function, _shared))
    parameters = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in (*list(own)[1:], *shared)]
    positional = {p.name for p in parameters if isinstance(p.annotation.__metadata__[0], ArgumentInfo)}

    @functools.wraps(function)
    def run(json: bool, quiet: bool, verbose: bool, **arguments: Any) -> None:
        options = {name: value for name, value in arguments.items() if name not in positional}
        with console.logging_to_stderr(quiet, verbose):
            try:
                with console.Progress(quiet) as progress:
                    answer = function(Context(function.__name__, options, progress), **arguments)
                if json:
                    console.answer(answer.data)
                else:
                    answer.show()
                code = answer.exit_code
            except BrokenPipeError:  # nobody reads stdout any more: typer ends quietly
                raise
            except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001 - each becomes a line and a code
                code = fail(error, json, verbose, options)
        raise typer.Exit(code)

    vars(run)["__signature__"] = inspect.Signature(parameters)
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def fail(error: BaseException, json: bool, verbose: bool = False, options: Iterable[str] = ()) -> int:
    """Print an error as one line, and as JSON; returns the exit code."""
    code, message, kind = FAILED, str(error), type(error).__name__
    if isinstance(error, LtclError):
        message = _naming_options(message, options)
    elif isinstance(error, MemoryError):
        message = "the host has no memory left"
    elif isinstance(error, KeyboardInterrupt):
        code, message = INTERRUPTED, message or "interrupted"
    elif kind == "UsageError":
        code = USAGE
    else:
        code, message = INTERNAL, f"internal error: {kind}: {error}; --verbose prints where it occurred"
        if verbose:
            typer.echo("".join(traceback.format_exception(error)), err=True)
    if json:
        console.answer({"error": message, "type": kind, "exit_code": code})
    console.error(message)
    return code


def _naming_options(message: str, options: Iterable[str]) -> str:
    """The message as it is, followed by the options that set the arguments it names.

    >>> _naming_options("give grid=(h, w); bounds[0] is nan", ["grid", "on_dark", "low", "high"])
    'give grid=(h, w); bounds[0] is nan (--grid, --low, --high)'
    """
    names = {name: [name] for name in options}
    names |= {name: several for name, several in _SEVERAL.items() if names.keys() >= {*several}}
    mentioned = [name for name in names if re.search(rf"(?<![-\w.]){name}(=| is |\[)", message)]
    shown = ", ".join(f"--{each.replace('_', '-')}" for name in mentioned for each in names[name])
    return f"{message} ({shown})" if shown else message
