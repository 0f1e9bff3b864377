# SPDX-License-Identifier: BSD-3-Clause
"""Output of the program: results on stdout, lines for the user on stderr.

A result that cannot be written, as on a full disk, is an error. A line for the user that cannot be
written is lost, and the work goes on. Characters that a stream cannot encode, as of file names that
are not UTF-8, are written as JSON escapes them.
"""

from __future__ import annotations

import codecs
import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TextIO

import typer

from ltcl.errors import FileError, LtclError

# Name of the handler of characters that cannot be encoded.
ESCAPED = "ltcl.escaped"


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
        typer.echo(_escaped(text, sys.stdout))


def print_line(text: str) -> None:
    """Print a line for the user on stderr, if that can be written."""
    try:
        typer.echo(_escaped(text, sys.stderr), err=True)
    except OSError:
        _discard(sys.stderr)


def _escaped(text: str, stream: TextIO) -> str:
    """Escape what a strict stream cannot encode, in units of UTF-16 as JSON does."""
    if getattr(stream, "errors", None) != "strict":
        return text
    return text.encode(stream.encoding, ESCAPED).decode(stream.encoding)


def _escape(error: UnicodeError) -> tuple[str, int]:
    """Handle the characters of a text that cannot be encoded."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    characters = error.object[error.start : error.end]
    units = characters.encode("utf-16-be", "surrogatepass").hex(" ", 2).split()
    return "".join(f"\\u{unit}" for unit in units), error.end


codecs.register_error(ESCAPED, _escape)


def _discard(stream: TextIO) -> None:
    """Discard what a stream still holds, or Python would complain at the end of the program."""
    with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), stream.fileno())
