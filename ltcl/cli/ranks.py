# SPDX-License-Identifier: BSD-3-Clause
"""A command on every rank of MPI: all do the same work, and the first alone writes and prints."""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable

from ltcl.errors import InputError

_PATIENCE = 5.0  # seconds within which ranks that fail alike do so


def on_every_rank(run: Callable[[list[str]], int], words: list[str]) -> int:
    """The exit code of `run(words)`; a rank that fails alone prints why and ends the others."""
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:  # the latter where it finds no library
        raise InputError(f"--mpi needs mpi4py and an MPI, pip install mpi4py mpich: {error}") from error
    ends, said = MPI.COMM_WORLD.Dup(), io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as silence:
        if ends.rank > 0:
            words = [*words, "--out", f"{folder}/out"]  # the last one counts
            silence.enter_context(contextlib.redirect_stdout(io.StringIO()))
            silence.enter_context(contextlib.redirect_stderr(said))
        code = run(words)
        all_ended, limit = ends.Ibarrier(), time.monotonic() + _PATIENCE
        while not all_ended.Test():
            if code and time.monotonic() > limit:
                silence.close()
                sys.stderr.write(said.getvalue())
                ends.Abort(code)
            time.sleep(0.01)
    return code
