# SPDX-License-Identifier: BSD-3-Clause
"""The program `ltcl`: its commands, and what becomes of errors.

Exit codes: 0 done; 1 refused or failed, with one line on stderr; 2 wrong usage; 130 Ctrl-C.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from ltcl import __version__
from ltcl.cli import (
    acquire,
    analyze,
    compensate,
    compress,
    console,
    convert,
    demo,
    devices,
    doctor,
    info,
    invert,
    relight,
    separate,
    simulate,
)
from ltcl.errors import LtclError

_UsageError: Any = typer.BadParameter.__base__  # typer exports those below it only
_GIVEN = "ltcl.given"  # of a context: the words after the program's name


class _Commands(TyperGroup):
    """Turns what a command raises on purpose, and wrong usage, into one line and an exit code."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta[_GIVEN] = given = list(args)
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            if not given:  # which shows the help
                raise
            raise _failed(_usage(error, given), 2) from error

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            raise _failed(_usage(error, ctx.meta[_GIVEN]), 2) from error
        except LtclError as error:
            raise _failed(str(error), 1) from error
        except MemoryError as error:
            raise _failed("the host has no memory left", 1) from error
        except KeyboardInterrupt:
            raise _failed("interrupted", 130) from None


def _failed(message: str, code: int) -> typer.Exit:
    console.error(as_options(message))
    return typer.Exit(code)


# What typer says of a value, and how we say it.
_TYPERS = (
    ("^Value error, .* is not one of ", "it must be one of "),
    ("^Input should be", "it must be"),
    (", unable to parse .*", ""),
)


def _usage(error: Any, given: Sequence[str]) -> str:
    """Wrong usage in one line: the option, what it was, what it must be, where there is more to read."""
    path = error.ctx.command_path if error.ctx else "ltcl"
    text = error.format_message().rstrip(".")
    names = getattr(getattr(error, "param", None), "opts", [])
    for value in filter(None, (_value(given, name) for name in names)):
        _, _, wanted = text.partition(": ")
        for typers, ours in _TYPERS:
            wanted = re.sub(typers, ours, wanted)
        text = f"{'/'.join(names)} is {value!r}; {wanted.replace(f'{value!r} is', 'it is')}"
    return f"{text}; see '{path} --help'"


def _value(given: Sequence[str], name: str) -> str | None:
    """What stands behind an option.

    >>> _value(["info", "--size", "2"], "--size"), _value(["--size=2"], "--size"), _value(["2"], "--size")
    ('2', '2', None)
    """
    for word, behind in zip(given, [*given[1:], None], strict=True):
        if word == name:
            return behind
        if word.startswith(f"{name}="):
            return word.removeprefix(f"{name}=")
    return None


# How the library's messages name arguments that are options here.
_ARGUMENT = re.compile(
    r"\b(grid|camera_grid|on_dark|first_bounce|method|rtol|gain|loss|batch|format|encoding)="
    r"(?:'([\w-]+)'|\((\w+), (\w+)\)|(\d[\d.e-]*))"
)
_SUBJECT = re.compile(r"(^|: |; )(rtol|method|exact|inverse|budget|fps)(?= (?:is|has|mixes) )")
_RTOL = re.compile(r"(\brtol is \S+; it must be) (?:a finite number at least 0 and below 1|above 0$)")
_COMMAND = re.compile(r"ltcl\.(invert|compress)\(T(?:, (\w+)=(?:\.\.\.|'(\w+)'))?\)")

_WORDS = {
    ", or atol above 0": "",
    "bounds is (": "(--low, --high) is (",
    "bounds[0] is": "--low is",
    "bounds[1] is": "--high is",
    "resume=True": "--resume",
    "resize=True": "--resize",
    "exact=T, the": "--exact FILE, the",
    "exact= corrects": "--exact corrects",
    "but inverse takes": "but --inverse takes",
    "load it with ltcl.load_inverse and give it as inverse= to": "give it as --inverse FILE to",
}


def as_options(message: str) -> str:
    """A message of the library in the words of the command line.

    >>> as_options("give grid=(h, w), perhaps grid=(64, 64); or on_dark='mask'")
    'give --grid HxW, perhaps --grid 64x64; or --on-dark mask'
    """

    def option(found: re.Match[str]) -> str:
        name, word, rows, columns, number = found.groups()
        value = word or number or f"{rows}x{columns}".replace("hxw", "HxW")
        return f"--{name.replace('_', '-')} {value}"

    def command(found: re.Match[str]) -> str:
        name, given, value = found.groups(default="")
        return f"'{' '.join(filter(None, ('ltcl', name, given and f'--{given}', value)))}'"

    for words, shown in _WORDS.items():
        message = message.replace(words, shown)
    message = _RTOL.sub(r"\1 above 0 and below 1", message)
    message = _SUBJECT.sub(r"\1--\2", _COMMAND.sub(command, message))
    return _ARGUMENT.sub(option, message)


class _Log(logging.Handler):
    """Warnings of the library as lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        typer.echo(f"ltcl: {record.levelname.lower()}: {record.getMessage()}", err=True)


app = typer.Typer(
    cls=_Commands,
    name="ltcl",
    help="Inverse light transport on any OpenCL device.",
    epilog="Start with: ltcl demo",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in (
    devices,
    doctor,
    demo,
    simulate,
    info,
    analyze,
    convert,
    compress,
    invert,
    compensate,
    separate,
    relight,
):
    app.command(command.__name__.rpartition(".")[2])(command.run)
app.add_typer(acquire.app, name="acquire")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ltcl {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    logger = logging.getLogger("ltcl")
    if not any(isinstance(handler, _Log) for handler in logger.handlers):
        logger.addHandler(_Log(logging.WARNING))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments`, those of the command line when not given; returns its exit code.

    Examples
    --------
    >>> main(["--version"])  # doctest: +ELLIPSIS
    ltcl ...
    0
    """
    try:
        app(args=None if arguments is None else list(arguments), prog_name="ltcl")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:  # before a command began, or while one was cleaning up
        console.error("interrupted")
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
