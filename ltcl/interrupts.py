# SPDX-License-Identifier: BSD-3-Clause
"""Ctrl-C while the program `ltcl` is still being loaded: one line and the exit code 130, as later on.

A program that uses the library is left alone. Before the first line of this package runs, Python itself says
what it says.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from types import TracebackType

_CODE = 130


def is_program(started: Sequence[str]) -> bool:
    """Whether this process was started as `ltcl`, by its script or by `python -m ltcl`.

    >>> is_program(["python", "-m", "ltcl", "info"]), is_program(["python", "/usr/bin/ltcl", "info"])
    (True, True)
    >>> is_program(["python", "mine.py", "ltcl"]), is_program(["python", "-m", "mine"])
    (False, False)
    """
    words = list(started[1:])
    while words and words[0].startswith("-") and words[0] != "-m":
        words = words[2:] if words[0] in ("-W", "-X") else words[1:]
    if words[:1] == ["-m"]:
        return words[1:2] == ["ltcl"]
    return bool(words) and os.path.splitext(os.path.basename(words[0]))[0] == "ltcl"


def end_in_one_line() -> None:
    """Let Ctrl-C that nothing catches end the program so, and not with a traceback."""
    others = sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if not issubclass(kind, KeyboardInterrupt):
            others(kind, error, trace)
            return
        sys.stderr.write("ltcl: error: interrupted\n")
        sys.stderr.flush()
        os._exit(_CODE)  # to return would be to die of the signal, and atexit has nothing to clean up yet

    sys.excepthook = hook
