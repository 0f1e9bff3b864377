# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C while no command runs: one line and exit code 130, as in a command.

Importing takes a second, in which no command can catch a KeyboardInterrupt, and so do the parsing
of words and the end of the program. There a handler of the signal ends the process. Importing this
module installs it, but only if Python was started for the program: others who import ltcl keep
their handlers.

Known limit: Ctrl-C in the first 0.1 s, before Python imports ltcl, is Python's.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

INTERRUPTED = 130


def is_program() -> bool:
    """Return True if Python was started for `ltcl` or `python -m ltcl`."""
    # Processes of multiprocessing have the words of the program that started them.
    is_worker = "--multiprocessing-fork" in sys.orig_argv
    if is_worker or len(sys.argv) > len(sys.orig_argv):
        return False
    # Of `python -m ltcl info` sys.argv has two words by now, and the second last is the module.
    started = PurePath(sys.orig_argv[-len(sys.argv)])
    return started.stem == "ltcl"


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt in a block, which handles it."""
    _exchange(_end, signal.default_int_handler)
    try:
        yield
    finally:
        if is_program():
            _exchange(signal.default_int_handler, _end)


def _exchange(present: Any, handler: Any) -> None:
    """Install a handler in the place of the present one; other handlers stay."""
    if signal.getsignal(signal.SIGINT) is present:
        signal.signal(signal.SIGINT, handler)


def _end(*_: Any) -> None:
    os.write(2, b"ltcl: error: interrupted\n")
    if "--json" in sys.orig_argv:
        report = {"error": "interrupted", "type": "KeyboardInterrupt", "exit_code": INTERRUPTED}
        os.write(1, f"{json.dumps(report, indent=2)}\n".encode())
    os._exit(INTERRUPTED)


if is_program():
    _exchange(signal.default_int_handler, _end)
    # The first to be registered runs last: then all is done, and Python frees its memory.
    atexit.register(_exchange, _end, signal.SIG_IGN)
