# SPDX-License-Identifier: BSD-3-Clause
"""The program `ltcl`: its commands, wrong usage, and a command on every rank of MPI."""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated

import typer

from ltcl import __version__
from ltcl.cli import acquire, compensate, doctor, files, view
from ltcl.cli.command import EXIT_CODES, USAGE, UsageError, fail
from ltcl.errors import InputError, LtclError

_PATIENCE = 5.0  # seconds within which ranks that fail alike do so
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
_COMMANDS = [
    doctor.devices,
    doctor.doctor,
    doctor.demo,
    acquire.simulate,
    files.info,
    files.analyze,
]
_COMMANDS += [files.convert, files.compress, files.invert, files.denoise, compensate.compensate]
_COMMANDS += [compensate.separate, compensate.relight, view.view, view.play, view.show]
for _command in _COMMANDS:
    app.command()(_command)
app.add_typer(acquire.app, name="acquire")


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
    return _run_on_every_rank(words) if "--mpi" in words else _run(words)


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


def _run_on_every_rank(words: list[str]) -> int:
    """All do the same, and the first alone writes and prints; one that fails alone says why and ends all."""
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:  # the latter where it finds no library
        problem = InputError(f"--mpi needs mpi4py and an MPI, pip install mpi4py mpich: {error}")
        return fail(problem, "--json" in words)["exit_code"]
    ends, said, out, err = MPI.COMM_WORLD.Dup(), io.StringIO(), sys.stdout, sys.stderr
    with tempfile.TemporaryDirectory() as folder:
        if ends.rank > 0:
            words, out, err = (
                [*words, "--out", f"{folder}/out"],
                io.StringIO(),
                said,
            )  # the last --out counts
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = _run(words)
    all_ended, limit = ends.Ibarrier(), time.monotonic() + _PATIENCE
    while not all_ended.Test():
        if code and time.monotonic() > limit:
            sys.stderr.write(said.getvalue())
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # where MPI says of itself that it ends
            ends.Abort(code)
        time.sleep(0.01)
    return code
