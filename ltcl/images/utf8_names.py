# SPDX-License-Identifier: BSD-3-Clause
"""Names of files for libraries in C++, which take UTF-8 alone.

Names of other bytes, as of old memory cards and archives, are read and written through a temporary
file.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path


def is_utf8(path: Path) -> bool:
    """True if the whole path is valid UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


@contextlib.contextmanager
def name_to_read(path: Path) -> Iterator[Path]:
    """`path`, or a temporary copy of the file."""
    if is_utf8(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        yield Path(shutil.copyfile(path, Path(folder) / f"copy{path.suffix}"))


@contextlib.contextmanager
def name_to_write(path: Path) -> Iterator[Path]:
    """`path`, or a temporary file whose content goes to `path` when the block ends well."""
    if is_utf8(path):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / f"copy{path.suffix}"
        yield temporary
        shutil.copyfile(temporary, path)
