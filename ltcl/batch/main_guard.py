# SPDX-License-Identifier: BSD-3-Clause
"""The main guard: processes that Python spawns import the file of the program once more.

A file that starts workers as it is imported would start them in every worker, which Python refuses
with long tracebacks in each. So the file is read before any worker is started.
"""

from __future__ import annotations

import ast
import sys
import threading
from multiprocessing.spawn import get_preparation_data
from pathlib import Path
from types import FrameType

from ltcl.errors import ClusterError

GUARD = 'if __name__ == "__main__":'


def check_main_guard() -> None:
    """Refuse to start processes if the program's file does so outside of the main guard."""
    frame = _main_frame()
    # A prompt, a notebook and a package's __main__ are not imported by a new process.
    is_imported = any(key.startswith("init_main") for key in get_preparation_data(""))
    if frame is None or not is_imported:
        return
    path = frame.f_code.co_filename
    line = frame.f_lineno
    if not _is_guarded(Path(path), line):
        raise ClusterError(
            f"{path}, line {line}: starts workers outside of {GUARD!r}; "
            "each worker imports this file, and must not start others"
        )


def _main_frame() -> FrameType | None:
    """Return the frame in which the program's file runs; None once it has ended."""
    module = vars(sys.modules["__main__"])
    frame = sys._current_frames().get(threading.main_thread().ident or 0)
    while frame is not None:
        if frame.f_globals is module and frame.f_code.co_name == "<module>":
            return frame
        frame = frame.f_back
    return None


def _is_guarded(path: Path, line: int) -> bool:
    """True if the statement at a line tests the module's name, or cannot be read."""
    try:
        statements = ast.parse(path.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return True
    for statement in statements:
        if statement.lineno <= line <= (statement.end_lineno or 0):
            nodes = ast.walk(statement)
            return any(isinstance(node, ast.Name) and node.id == "__name__" for node in nodes)
    return True
