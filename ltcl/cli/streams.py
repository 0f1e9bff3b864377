# SPDX-License-Identifier: BSD-3-Clause
"""Output of the program: results on stdout, lines for the user on stderr.

A result that cannot be written, as on a full disk, is an error. A line for the user that cannot be
written is lost, and the work goes on.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TextIO

import typer

from ltcl.errors import FileError, LtclError


@contextlib.contextmanager
def checked_stdout() -> Iterator[None]:
    """Raise FileError in this block if stdout cannot be written.

    A pipe that nobody reads stays a BrokenPipeError, by which typer ends the program quietly.
    """
    try:
        yield
    except (BrokenPipeError, LtclError):
        raise
    except OSError as error:
        _discard(sys.stdout)
        raise FileError(f"stdout: cannot be written: {error.strerror}") from None


def print_result(text: str) -> None:
    """Print on stdout; FileError if it cannot be written."""
    if sys.stdout is None:
        raise FileError("stdout: cannot be written: it is closed")
    with checked_stdout():
        typer.echo(text)


def print_line(text: str) -> None:
    """Print a line for the user on stderr, if that can be written."""
    try:
        typer.echo(text, err=True)
    except OSError:
        _discard(sys.stderr)


def _discard(stream: TextIO) -> None:
    """Discard what a stream still holds, or Python would complain at the end of the program."""
    with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())
