# SPDX-License-Identifier: BSD-3-Clause
"""What libpng and libjpeg write on stderr while they decode, caught: with OpenCV there is no other way to it.

Only their lines are; what anything else writes meanwhile comes out behind. One decoder at a time.
"""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import threading
from collections.abc import Iterator

_LINE = re.compile(rb"libpng (?:error|warning): .*|(?:Corrupt|Premature end of|Invalid|Unsupported) JPEG.*")
_lock = threading.Lock()


@contextlib.contextmanager
def overheard() -> Iterator[list[str]]:
    """Lines of the decoders, in a list that is filled at the end.

    >>> with overheard() as said:
    ...     count = os.write(2, b"libpng error: bad adaptive filter value")
    >>> said
    ['libpng error: bad adaptive filter value']
    """
    said: list[str] = []
    with _lock, contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(tempfile.TemporaryFile())
            own = os.dup(2)
        except OSError:  # no stderr, or nowhere to keep it: nothing is caught
            yield said
            return
        os.dup2(file.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(own, 2)
            os.close(own)
            file.seek(0)
            for line in file.read().splitlines(keepends=True):
                if _LINE.fullmatch(line.rstrip()):
                    said.append(line.decode(errors="replace").rstrip())
                else:
                    os.write(2, line)
