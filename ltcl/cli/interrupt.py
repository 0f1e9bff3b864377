# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C while the program is imported: one line and exit code 130, as later.

Importing takes a second, in which no command can catch a KeyboardInterrupt. So a handler of the
signal ends the process until the program begins. Importing this module installs it, but only if
Python was started for the program: others who import ltcl keep their handlers.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import PurePath
from typing import Any

INTERRUPTED = 130


def is_program() -> bool:
    """Return True if Python was started for `ltcl` or `python -m ltcl`."""
    # Of `python -m ltcl info` sys.argv has two words by now, and the second last is the module.
    started = PurePath(sys.orig_argv[-len(sys.argv)])
    is_worker = "--multiprocessing-fork" in sys.orig_argv
    return started.stem == "ltcl" and not is_worker


def release() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(*_: Any) -> None:
    os.write(2, b"ltcl: error: interrupted\n")
    if "--json" in sys.orig_argv:
        report = {"error": "interrupted", "type": "KeyboardInterrupt", "exit_code": INTERRUPTED}
        os.write(1, f"{json.dumps(report, indent=2)}\n".encode())
    os._exit(INTERRUPTED)


if is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _end)
