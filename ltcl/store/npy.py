# SPDX-License-Identifier: BSD-3-Clause
"""Dense transports as .npy: T of (M, N), or (3, M, N) for RGB. Grids and first bounce are not kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltcl.errors import FileError, InputError
from ltcl.store import arrays
from ltcl.store.record import Record

KEEPS_FIRST_BOUNCE = False


def read(path: Path) -> Record:
    """Read the matrix of a .npy file; messages come without the file's name."""
    with path.open("rb") as file:
        header = arrays.read_header(file, "the array")
        arrays.check_length(header, path.stat().st_size - header.start, "the array")
        check_shape(header, "the array")
        T = arrays.as_floats("the array", arrays.read_values(file, header, "the array"))
    return Record(channels(T))


def write(path: Path, record: Record) -> None:
    """Write the matrix of `record`, which must be dense."""
    matrices = [T for T in record.matrices if isinstance(T, np.ndarray)]
    if not record.dense:
        raise InputError("T is sparse, and .npy holds dense arrays only; save it as .npz")
    with path.open("wb") as file:
        arrays.write_stack(file, matrices)


def check_shape(header: arrays.Header, name: str) -> None:
    """Refuse anything but real numbers of (M, N), (1, M, N) or (3, M, N), none of them zero."""
    if header.dtype.kind not in "fiub":
        raise FileError(f"{name} holds {header.dtype}; it must hold real numbers")
    if not is_matrix_shape(header.shape):
        raise FileError(f"{name} has shape {header.shape}; T must be (M, N) or (3, M, N), not empty")


def is_matrix_shape(shape: tuple[int, ...]) -> bool:
    """Whether an array of `shape` can be a transport."""
    return 0 not in shape and (len(shape) == 2 or (len(shape) == 3 and shape[0] in (1, 3)))


def channels(T: np.ndarray) -> tuple[np.ndarray, ...]:
    """Split (M, N) or (k, M, N) into matrices, without a copy."""
    return (T,) if T.ndim == 2 else tuple(T)
