# SPDX-License-Identifier: BSD-3-Clause
"""The program `ltcl`: its commands, wrong usage, and a command on every rank of MPI."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import typer

from ltcl import __version__
from ltcl.cli import (
    acquire,
    align,
    analyze,
    compensate,
    convert,
    demo,
    doctor,
    export,
    film,
    info,
    ranks,
    relight,
    separate,
    show,
    simulate,
    transform,
    view,
)
from ltcl.cli.command import EXIT_CODES, USAGE, UsageError, fail
from ltcl.cli.streams import checked_stdout, print_result
from ltcl.errors import LtclError

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
PANELS: dict[str, list[Any]] = {
    "First steps": [demo.demo, doctor.devices, doctor.doctor],
    "Pictures and films": [
        compensate.compensate,
        film.film,
        separate.separate,
        relight.relight,
    ],
    "Transport files": [
        info.info,
        analyze.analyze,
        convert.convert,
        align.align,
        transform.compress,
        transform.invert,
        transform.denoise,
    ],
    "Display": [view.view, show.play, show.show, export.export],
    "Measurement": [simulate.simulate],
}
for _panel, _commands in PANELS.items():
    for _command in _commands:
        app.command(rich_help_panel=_panel)(_command)
app.add_typer(acquire.app, name="acquire", rich_help_panel="Measurement")


@app.callback(invoke_without_command=True)
def _program_options(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    if version:
        print_result(f"ltcl {__version__}")
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program with `arguments`, by default those of the command line.

    Returns the exit code.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if "--mpi" in words:
        return ranks.run_on_every_rank(run, words)
    return run(words)


def run(words: list[str]) -> int:
    """Run the program in this process."""
    try:
        # Help is printed by typer.
        with checked_stdout():
            return app(args=words, prog_name="ltcl", standalone_mode=False) or 0
    except UsageError as error:
        return _refuse_usage(error, words)
    except (LtclError, KeyboardInterrupt) as error:
        # The command has not begun yet, or stdout cannot be written.
        return fail(error, "--json" in words).exit_code
    except SystemExit as end:
        # The pipe that reads stdout was closed.
        return end.code if isinstance(end.code, int) else 1


def _refuse_usage(error: Any, words: list[str]) -> int:
    """Print what is wrong with an option and its value, and where its help is."""
    message = error.format_message().rstrip(".")
    if not message:
        # Help was shown.
        return USAGE
    parameter = getattr(error, "param", None)
    option_names = getattr(parameter, "opts", [])
    values = [value for name, value in pairwise(words) if name in option_names]
    if values and values[0] not in message:
        message += f"; it is {values[0]}"
    path = error.ctx.command_path if error.ctx else "ltcl"
    failure = fail(UsageError(f"{message}; see '{path} --help'"), "--json" in words)
    return failure.exit_code
