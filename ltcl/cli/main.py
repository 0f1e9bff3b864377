# SPDX-License-Identifier: BSD-3-Clause
"""The program `ltcl`: its commands, and wrong usage."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import typer

from ltcl import __version__
from ltcl.cli import ranks
from ltcl.cli.acquire import app as acquire
from ltcl.cli.acquire import simulate
from ltcl.cli.command import EXIT_CODES, USAGE, UsageError, fail
from ltcl.cli.compensate import compensate, relight, separate
from ltcl.cli.doctor import demo, devices, doctor
from ltcl.cli.files import analyze, compress, convert, denoise, info, invert
from ltcl.cli.view import play, show, view
from ltcl.errors import InputError, LtclError

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
_FILES = (info, analyze, convert, compress, invert, denoise)
for _command in (devices, doctor, demo, simulate, *_FILES, compensate, separate, relight, view, play, show):
    app.command()(_command)
app.add_typer(acquire, name="acquire")


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"ltcl {__version__}")
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments`, by default those of the command line; returns its exit code."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        return ranks.on_every_rank(_run, words) if "--mpi" in words else _run(words)
    except InputError as error:  # there is no MPI
        return fail(error, "--json" in words)["exit_code"]


def _run(words: list[str]) -> int:
    try:
        return app(args=words, prog_name="ltcl", standalone_mode=False) or 0
    except UsageError as error:
        message = error.format_message().rstrip(".")
        if not message:  # help was shown
            return USAGE
        options = getattr(getattr(error, "param", None), "opts", [])
        value = next((value for name, value in pairwise(words) if name in options), "")
        message += "" if value in message else f"; it is {value}"
        path = error.ctx.command_path if error.ctx else "ltcl"
        return fail(UsageError(f"{message}; see '{path} --help'"), "--json" in words)["exit_code"]
    except (LtclError, KeyboardInterrupt) as error:  # before a command began
        return fail(error, "--json" in words)["exit_code"]
    except SystemExit as end:  # of a pipe that was closed
        return end.code if isinstance(end.code, int) else 1


if __name__ == "__main__":
    sys.exit(main())
