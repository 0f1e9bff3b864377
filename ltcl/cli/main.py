# SPDX-License-Identifier: BSD-3-Clause
"""The program `ltcl`: its commands, and wrong usage."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import typer

from ltcl import __version__
from ltcl.cli.acquire import app as acquire
from ltcl.cli.analyze import analyze
from ltcl.cli.command import EXIT_CODES, USAGE, command, fail
from ltcl.cli.compensate import compensate
from ltcl.cli.compress import compress
from ltcl.cli.convert import convert
from ltcl.cli.demo import demo
from ltcl.cli.devices import devices
from ltcl.cli.doctor import doctor
from ltcl.cli.info import info
from ltcl.cli.invert import invert
from ltcl.cli.relight import relight
from ltcl.cli.separate import separate
from ltcl.cli.show import show
from ltcl.cli.simulate import simulate
from ltcl.errors import LtclError

_UsageError: Any = typer.BadParameter.__base__  # typer exports those below it only
_COMMANDS = (devices, doctor, demo, simulate, info, analyze, convert, compress, invert)

app = typer.Typer(
    name="ltcl",
    help="Inverse light transport on any OpenCL device. Start with: ltcl demo",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _function in (*_COMMANDS, compensate, separate, relight, show):
    app.command()(command(_function))
app.add_typer(acquire, name="acquire")


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
    pass


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments`, those of the command line when not given; returns its exit code.

    Examples
    --------
    >>> main(["--version"])  # doctest: +ELLIPSIS
    ltcl ...
    0
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return app(args=words, prog_name="ltcl", standalone_mode=False) or 0
    except _UsageError as error:
        message = error.format_message()
        return fail(UsageError(_explain(error, words)), "--json" in words) if message else USAGE  # else help
    except (LtclError, KeyboardInterrupt) as error:  # before a command began
        return fail(error, "--json" in words)
    except SystemExit as end:  # of a pipe that was closed
        return end.code if isinstance(end.code, int) else 1


class UsageError(Exception):
    """The command line cannot be understood."""


def _explain(error: Any, words: Sequence[str]) -> str:
    """What typer says, the value it was, and where there is more to read."""
    names = getattr(getattr(error, "param", None), "opts", [])
    message, path = error.format_message().rstrip("."), error.ctx.command_path if error.ctx else "ltcl"
    value = next((value for name, value in pairwise(words) if name in names), "")
    return f"{message}{'' if value in message else f'; it is {value}'}; see '{path} --help'"


if __name__ == "__main__":
    sys.exit(main())
