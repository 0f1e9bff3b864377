# SPDX-License-Identifier: BSD-3-Clause
"""Formats of transport files by extension: modules with `read(path) -> Record` and `write(path, record)`.

The modules say what is wrong, and here the file's name is put in front: one line about one file.
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path
from types import ModuleType
from typing import Any

from ltcl.errors import FileError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.store import hdf5, matlab, mtx, npy, npz, zarr_folder
from ltcl.store.compressed import Parts
from ltcl.store.record import Record
from ltcl.store.refusals import about

logger = logging.getLogger(__name__)

FORMATS: dict[str, ModuleType] = {
    ".npz": npz,
    ".npy": npy,
    ".mtx": mtx,
    ".h5": hdf5,
    ".hdf5": hdf5,
    ".mat": matlab,
    ".zarr": zarr_folder,
}


def read(path: str | Path) -> Record | Parts:
    """Read a transport file; of a compressed transport its parts.

    Raises
    ------
    FileError
        Missing, empty, of an unknown extension, damaged, truncated, lying about a size, or not a transport.
    MemoryLimitError
        What it honestly declares does not fit the host.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> path = Path(tempfile.mkdtemp()) / "T.npz"
    >>> write(path, Record((np.eye(6),), grid=(2, 3)))
    >>> read(path).grid
    (2, 3)
    """
    path = as_path(path)
    module = find(path)
    if module is mtx and not path.exists() and any(one.exists() for one in mtx.beside(path)):
        channels = [_read(mtx, one) for one in mtx.beside(path)]
        with about(path):
            return mtx.together(channels)
    return _read(module, path)


def _read(module: ModuleType, path: Path) -> Any:
    if module is not zarr_folder:
        input_file(path)
    with about(path):
        return module.read(path)


def write(path: str | Path, record: Record | Parts) -> None:
    """Write a transport file whole or not at all.

    Raises
    ------
    FileError
        The extension is unknown, or the file cannot be written.
    InputError
        The format cannot hold this transport.
    """
    path = as_path(path)
    module = find(path)
    if isinstance(record, Parts):
        if module not in (npz, zarr_folder):
            raise FileError(f"{path}: {path.suffix} does not keep compressed transports; .npz and .zarr do")
    elif record.mixing is not None and not module.KEEPS_FIRST_BOUNCE:
        raise FileError(f"{path}: {path.suffix} does not keep how the projector's colours mix; .npz does")
    elif not module.KEEPS_FIRST_BOUNCE and not record.bounces_from_diagonal:
        logger.warning("%s: %s does not keep the first bounce; .npz does", path, path.suffix)
    if module is zarr_folder:
        with about(path):
            zarr_folder.write(path, record)
        return
    if isinstance(record, Record):
        with about(path):
            record = record.in_memory()
    if module is mtx and isinstance(record, Record) and len(record.matrices) == 3:
        _write_beside(path, record)
        return
    with replace_file(path) as temporary, about(path):
        module.write(temporary, record)


def _write_beside(path: Path, record: Record) -> None:
    """Each channel as a .mtx file of its own."""
    if path.exists():
        names = ", ".join(one.name for one in mtx.beside(path))
        raise FileError(f"{path}: is there, and would be read in place of the channels {names}; remove it")
    with contextlib.ExitStack() as stack:
        for one, T in zip(mtx.beside(path), record.matrices, strict=True):
            temporary = stack.enter_context(replace_file(one))
            with about(one):
                mtx.write(temporary, Record((T,), record.grid, record.camera_grid))


def find(path: Path) -> ModuleType:
    """Module of the format that the extension of `path` names; a folder may be a store by any other."""
    try:
        return FORMATS[path.suffix.lower()]
    except KeyError:
        if path.is_dir():
            return zarr_folder
        known = ", ".join(FORMATS)
        raise FileError(f"{path}: {unknown_extension(path)}; transports are {known}") from None
