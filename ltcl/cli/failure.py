# SPDX-License-Identifier: BSD-3-Clause
"""Errors of the program: one line on stderr, JSON if asked, and the exit codes."""

from __future__ import annotations

import traceback
from contextlib import suppress
from typing import Any

import typer

from ltcl.cli.reports.report import ErrorReport
from ltcl.cli.streams import print_line, print_result
from ltcl.errors import FileError, LtclError

FAILED = 1
USAGE = 2
WAITING = 3
INTERNAL = 70
INTERRUPTED = 130
EXIT_CODES = (
    "**Exit codes:** 0 done; 1 refused or failed, with one line that tells "
    "why; 2 wrong usage; 3 'ltcl acquire run', or 'update', waits for photographs "
    "that a person has to take; 70 an error in ltcl itself; 130 Ctrl-C.\n\n"
    "With **--json** stdout holds one JSON document, also if a command fails: "
    '{"error": the problem, "type": its class in ltcl.errors, '
    '"exit_code": as above}. docs/reference/json.md has all fields.'
)
# Typer exports only classes derived from this one.
UsageError: Any = typer.BadParameter.__base__


def fail(error: BaseException, json: bool = False, verbose: bool = False) -> ErrorReport:
    """Print an error as one line on stderr, and as JSON on stdout if asked; return its report."""
    kind = type(error).__name__
    message = " ".join(str(error).split())
    code = FAILED
    if isinstance(error, KeyboardInterrupt):
        code = INTERRUPTED
        if not message:
            message = "interrupted"
    elif isinstance(error, UsageError):
        code = USAGE
    elif isinstance(error, MemoryError) and not isinstance(error, LtclError):
        message = "the host has no memory left"
    elif not isinstance(error, LtclError):
        code = INTERNAL
        message = f"internal error: {kind}: {message}; --verbose prints where it occurred"
        if verbose:
            print_line("".join(traceback.format_exception(error)))
    print_line(f"ltcl: error: {message}")
    failure = ErrorReport(error=message, type=kind, exit_code=code)
    if json:
        with suppress(FileError):
            # It imports NumPy and the solvers.
            from ltcl.tasks import report

            print_result(report.dumps(failure.document()))
    return failure
