# SPDX-License-Identifier: BSD-3-Clause
"""Precomputed inverses on disk, as .npz: the layout of compressed transports under a name of its own."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ltcl.errors import FileError, InputTypeError
from ltcl.files import as_path, input_file, replace_file
from ltcl.solvers import Inverse
from ltcl.store import npz
from ltcl.store.headers import about
from ltcl.store.record import Parts


def save_inverse(path: str | os.PathLike[str], inverse: Inverse) -> None:
    """Save what `ltcl.invert` made as .npz; an earlier file at `path` is replaced whole or not at all.

    FileError for another extension, or where the file cannot be written.

    Examples
    --------
    >>> import ltcl, pathlib, tempfile
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "inverse.npz"
    >>> ltcl.save_inverse(path, ltcl.invert(T, rtol=1e-3))
    >>> ltcl.load_inverse(path).error <= 1e-3
    True
    """
    if not isinstance(inverse, Inverse):
        raise InputTypeError(f"inverse is a {type(inverse).__name__}; it must be what ltcl.invert(T) gives")
    path = check_name(path)
    with about(path), replace_file(path) as temporary:
        npz.write_arrays(temporary, {"format": npz.INVERSE, **Parts(inverse.to_arrays()).arrays})


def load_inverse(path: str | os.PathLike[str], *, device: Any = None) -> Inverse:
    """Load an inverse of `save_inverse` onto a device (as `open_device` takes it), with the same bits.

    FileError where the file is missing, damaged, lies about a size, or holds something else; MemoryLimitError
    where it does not fit the memory of the host or of the device.
    """
    parts = read(path)
    with about(as_path(path)):
        return Inverse.from_arrays(parts.arrays, device)


def read(path: str | os.PathLike[str]) -> Parts:
    """The arrays in a file of an inverse; needs no device. Raises as `load_inverse`."""
    path = check_name(path)
    input_file(path)
    with about(path), npz.Archive(path) as archive:
        if archive.layout() != npz.INVERSE:
            raise FileError(f"is no inverse, whose format is {npz.INVERSE}; ltcl.invert(T) makes one")
        return archive.parts()


def is_inverse(path: str | os.PathLike[str]) -> bool:
    """Whether a file says that it holds an inverse; not what is damaged, which its reader refuses."""
    path = as_path(path)
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    try:
        with npz.Archive(path) as archive:
            return archive.layout() == npz.INVERSE
    except (FileError, OSError):
        return False


def check_name(path: str | os.PathLike[str]) -> Path:
    """`path`, if its extension is that of an inverse."""
    path = as_path(path)
    if path.suffix.lower() != ".npz":
        raise FileError(f"{path}: the extension is {path.suffix!r}; inverses are .npz")
    return path
