# SPDX-License-Identifier: BSD-3-Clause
"""Whatever is refused about a file or folder comes as one line with its name in front."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from ltcl.errors import FileError, InputError, InputTypeError, MemoryLimitError


@contextlib.contextmanager
def about(path: Path) -> Iterator[None]:
    """Put the name of `path` in front of whatever is refused inside the block, unless it stands there.

    >>> with about(Path("T.npz")):
    ...     raise InputError("is empty")
    Traceback (most recent call last):
    ltcl.errors.FileError: T.npz: is empty
    """
    try:
        yield
    except (InputError, InputTypeError) as error:
        if isinstance(error, FileError) and str(error).startswith(f"{path}: "):
            raise
        raise FileError(f"{path}: {error}") from error.__cause__
    except MemoryError as error:
        raise MemoryLimitError(f"{path}: {error or 'the host has no memory left'}") from None
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from error
