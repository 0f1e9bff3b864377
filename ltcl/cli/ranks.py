# SPDX-License-Identifier: BSD-3-Clause
"""A command on every rank of MPI: all do the same work, and only the first writes and prints.

A rank that fails alone prints why, and ends all ranks.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

from ltcl.cli.failure import fail
from ltcl.errors import InputError

# Seconds within which ranks that fail with the same error do so.
COMMON_FAILURE_SECONDS = 5.0


def run_on_every_rank(run: Callable[[list[str]], int], words: list[str]) -> int:
    """Run the command `words` on this rank, and wait for all others."""
    try:
        MPI = _load_mpi()
    except InputError as error:
        return fail(error, "--json" in words).exit_code
    ranks = MPI.COMM_WORLD.Dup()
    if ranks.rank == 0:
        errors = io.StringIO()
        code = run(words)
    else:
        code, errors = _run_silently(run, words)
    _wait_for_all(ranks, code, errors.getvalue())
    return code


def _load_mpi() -> Any:
    # It imports NumPy.
    from ltcl import checks

    try:
        return checks.load_extra("mpi4py.MPI", "mpi", "--mpi")
    except RuntimeError as error:
        advice = "python -m pip install mpich brings one"
        raise InputError(f"--mpi finds no library of MPI ({error}); {advice}") from None


def _run_silently(run: Callable[[list[str]], int], words: list[str]) -> tuple[int, io.StringIO]:
    """Run with results in a temporary folder; return the exit code and what stderr would show."""
    errors = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(errors),
    ):
        # The last --out counts.
        code = run([*words, "--out", f"{folder}/out"])
    return code, errors


def _wait_for_all(ranks: Any, code: int, errors: str) -> None:
    """Wait until all ranks have ended; a rank that has failed ends those that have not."""
    all_ended = ranks.Ibarrier()
    limit = time.monotonic() + COMMON_FAILURE_SECONDS
    while not all_ended.Test():
        if code and time.monotonic() > limit:
            sys.stderr.write(errors)
            # MPI would add lines of its own to stderr.
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            ranks.Abort(code)
        time.sleep(0.01)
