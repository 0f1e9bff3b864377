# SPDX-License-Identifier: BSD-3-Clause
"""The program `ltcl`: its commands, wrong usage, and a command on every rank of MPI."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import typer
from typer.core import TyperArgument, TyperCommand, TyperGroup

from ltcl import __version__
from ltcl.cli import ranks
from ltcl.cli.failure import EXIT_CODES, USAGE, UsageError, fail
from ltcl.cli.streams import checked_stdout, print_result
from ltcl.errors import LtclError

# Commands under their headings: the place of each in ltcl.cli, and the line about it in the help
# of the program, which is printed without the modules of the commands: they take a second.
PANELS = {
    "First steps": {
        "demo": (
            "demo:demo",
            "Compensate a picture in a coloured room corner: no hardware, no download, half a "
            "minute.",
        ),
        "devices": (
            "doctor:devices",
            "List the OpenCL devices, the best first; the arrow marks the one that ltcl would use.",
        ),
        "doctor": (
            "doctor:doctor",
            "Try all that ltcl needs: Python, drivers, kernels, results, cache.",
        ),
    },
    "Pictures and films": {
        "compensate": (
            "compensate:compensate",
            "Find the projector patterns that make a scene look like PICTURE.",
        ),
        "film": (
            "film:film",
            "Find the projector patterns that make a scene look like each frame of FILM.",
        ),
        "separate": (
            "separate:separate",
            "Split PICTURE, taken of the scene under projector light, into direct light and "
            "bounces.",
        ),
        "relight": (
            "relight:relight",
            "Show the picture that the camera will see when PATTERN is projected.",
        ),
    },
    "Transport files": {
        "info": (
            "info:info",
            "Show size, channels, grid, entries and first bounce of transport files and inverses.",
        ),
        "analyze": (
            "analyze:analyze",
            "Show the spectrum of R, the cost of each method, and whether T is physically "
            "possible.",
        ),
        "convert": (
            "convert:convert",
            "Write a transport in another format; OUT is replaced whole or not at all. Needs no "
            "device.",
        ),
        "align": (
            "align:align",
            "Bring TRANSPORT onto the projector's grid, so that 'ltcl separate' finds its bounces.",
        ),
        "combine": (
            "projectors:combine",
            "Make one transport of several projectors, from scans with one camera that did not "
            "move.",
        ),
        "compress": ("transform:compress", "Write R in a basis where it is sparse."),
        "invert": (
            "transform:invert",
            "Find A = I - S^-1, one physical bounce, so that each further picture costs one "
            "product.",
        ),
        "denoise": (
            "transform:denoise",
            "Write TRANSPORT with less noise: average reciprocal pairs, shrink wavelet "
            "coefficients.",
        ),
    },
    "Display": {
        "view": (
            "view:view",
            "Look at TRANSPORT in the browser: probe, bounces, relight, compensate, projector.",
        ),
        "play": (
            "show:play",
            "Play FILM in a projector window of the browser, compensated for TRANSPORT.",
        ),
        "show": (
            "show:show",
            "Show patterns full screen, next by key, timer or photograph; Escape ends it.",
        ),
        "export": (
            "export:export",
            "Write what SCAN tells as static files for other software: maps, masks, MPCDI, mesh, "
            "colours.",
        ),
    },
    "Measurement": {
        "simulate": (
            "simulate:simulate",
            "Make a folder in which 'ltcl acquire' photographs SCENE, without a camera.",
        ),
        "acquire": (
            "acquire:app",
            "Photograph a scene under patterns, and make its transport of the photographs, in "
            "DIR/transport.zarr. DIR has an acquisition.toml, which describes the rig and the "
            "scan.",
        ),
    },
}
# Variables by which shells ask for completions of a line: bash, then zsh, fish and PowerShell.
COMPLETED_LINES = ("COMP_WORDS", "_TYPER_COMPLETE_ARGS")


class PlainCommand(TyperCommand):
    """A command whose help shows no types behind flags and arguments.

    Typer 0.29 prints <bool> and <list[Path]> there, earlier versions BOOLEAN and PATH.
    """

    def get_params(self, ctx: Any) -> list[Any]:
        """Options and arguments, --help among them."""
        return _without_types(super().get_params(ctx))


class PlainGroup(TyperGroup):
    """A program of several commands with the help of `PlainCommand`."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Options, --help among them."""
        return _without_types(super().get_params(ctx))


def _without_types(parameters: list[Any]) -> list[Any]:
    for parameter in parameters:
        if isinstance(parameter, TyperArgument):
            parameter.display_type_rich = _no_type
        elif parameter.is_flag:
            parameter.metavar = ""
    return parameters


def _no_type(ctx: Any) -> None:
    """Stand for the type of an argument, whose name says enough."""


def build_program(command: str | None = None) -> typer.Typer:
    """Return the program with the module of one command loaded, by default those of all.

    Commands that are not loaded have their line in the help, and nothing else.
    """
    app = typer.Typer(
        name="ltcl",
        cls=PlainGroup,
        help="Inverse light transport on any OpenCL device. Start with: ltcl demo",
        epilog=EXIT_CODES,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(invoke_without_command=True)(_program_options)
    for panel, commands in PANELS.items():
        for name, (place, line) in commands.items():
            if command not in (None, name):
                app.command(name, cls=PlainCommand, help=line, rich_help_panel=panel)(_not_loaded)
                continue
            module, _, member = place.partition(":")
            loaded = getattr(importlib.import_module(f"ltcl.cli.{module}"), member)
            if isinstance(loaded, typer.Typer):
                for inner in loaded.registered_commands:
                    inner.cls = PlainCommand
                app.add_typer(loaded, name=name, cls=PlainGroup, rich_help_panel=panel)
            else:
                app.command(name, cls=PlainCommand, rich_help_panel=panel)(loaded)
    return app


def _not_loaded() -> None:
    """Stand for a command that this run does not use."""


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
            app = build_program(_command_name(words))
            return app(args=words, prog_name="ltcl", standalone_mode=False) or 0
    except UsageError as error:
        return _refuse_usage(error, words)
    except (LtclError, KeyboardInterrupt) as error:
        # The command has not begun yet, or stdout cannot be written.
        return fail(error, "--json" in words).exit_code
    except SystemExit as end:
        # The pipe that reads stdout was closed.
        return end.code if isinstance(end.code, int) else 1


def _command_name(words: list[str]) -> str:
    """Return the command of a line, or of the line that a shell asks to complete."""
    for variable in COMPLETED_LINES:
        if variable in os.environ:
            words = os.environ[variable].split()[1:]
    names = [word for word in words if not word.startswith("-")]
    return names[0] if names else ""


def _refuse_usage(error: Any, words: list[str]) -> int:
    """Print what is wrong with an option and its value, and where its help is."""
    # Typer's name of the exception tells users nothing.
    message = error.format_message().replace("Value error, ", "").rstrip(".")
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
