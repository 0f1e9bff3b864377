# SPDX-License-Identifier: BSD-3-Clause
"""Formats of transport files by extension: functions that read and write a `Record` or `Parts`.

They say what is wrong, and here the file's name is put in front: one line about one file.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from ltcl.errors import FileError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.store import hdf5, matlab, mtx, npz, zarr_folder
from ltcl.store.headers import about
from ltcl.store.record import Parts, Record

logger = logging.getLogger(__name__)


class Format(NamedTuple):
    """How files of one kind are read and written, and what they keep."""

    read: Callable[..., Any]
    write: Callable[[Path, Any], None]
    variables: bool = True  # whether arrays have names
    first_bounce: bool = True
    compressed: bool = False


ZARR = Format(zarr_folder.read, zarr_folder.write, variables=False, compressed=True)
MTX = Format(mtx.read, mtx.write, variables=False, first_bounce=False)
_HDF5 = Format(hdf5.read, hdf5.write)
FORMATS: dict[str, Format] = {
    ".npz": Format(npz.read, npz.write, compressed=True),
    ".npy": Format(npz.read_npy, npz.write_npy, variables=False, first_bounce=False),
    ".mtx": MTX,
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".mat": Format(matlab.read, matlab.write),
    ".zarr": ZARR,
}


def read(path: str | Path, *, variable: str | None = None) -> Record | Parts:
    """Read a transport file, of a compressed transport its parts; errors and `variable` are those of `load`.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> path = Path(tempfile.mkdtemp()) / "T.npz"
    >>> write(path, Record((np.eye(6),), grid=(2, 3)))
    >>> read(path).grid
    (2, 3)
    """
    path = as_path(path)
    kind = find(path)
    if variable is not None and not kind.variables:
        raise FileError(f"{path}: variable is {variable!r}, but the matrix of this format has no name")
    if kind is MTX and not path.exists() and any(file.exists() for file in mtx.channel_files(path)):
        channels = [_read(kind, file, {}) for file in mtx.channel_files(path)]
        with about(path):
            return mtx.merge(channels)
    return _read(kind, path, {} if variable is None else {"variable": variable})


def _read(kind: Format, path: Path, options: dict[str, str]) -> Any:
    if kind is not ZARR:
        input_file(path)
    with about(path):
        return kind.read(path, **options)


def write(path: str | Path, content: Record | Parts) -> None:
    """Write a transport file whole or not at all; errors are those of `save`."""
    path = as_path(path)
    kind = find(path)
    if isinstance(content, Parts):
        if not kind.compressed:
            raise FileError(f"{path}: {path.suffix} does not keep compressed transports; .npz and .zarr do")
    elif content.mixing is not None and not kind.first_bounce:
        raise FileError(f"{path}: {path.suffix} does not keep how the projector's colours mix; .npz does")
    elif not kind.first_bounce and not content.bounces_from_diagonal:
        logger.warning("%s: %s does not keep the first bounce; .npz does", path, path.suffix)
    with about(path):
        if kind is ZARR:
            kind.write(path, content)
        elif kind is MTX and isinstance(content, Record) and len(content.matrices) == 3:
            _write_channels(path, content.in_memory())
        else:
            content = content.in_memory() if isinstance(content, Record) else content
            with replace_file(path) as temporary:
                kind.write(temporary, content)


def _write_channels(path: Path, record: Record) -> None:
    """Each channel as a .mtx file of its own."""
    if path.exists():
        names = ", ".join(file.name for file in mtx.channel_files(path))
        raise FileError(f"is there, and would be read in place of the channels {names}; remove it")
    with contextlib.ExitStack() as stack:
        for file, T in zip(mtx.channel_files(path), record.matrices, strict=True):
            mtx.write(stack.enter_context(replace_file(file)), Record((T,), record.grid, record.camera_grid))


def find(path: Path) -> Format:
    """The format that the extension of `path` names; a folder may be a store by any other."""
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        if path.is_dir():
            return ZARR
        known = ", ".join(FORMATS)
        raise FileError(f"{path}: {unknown_extension(path)}; transports are {known}") from None
