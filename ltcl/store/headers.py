# SPDX-License-Identifier: BSD-3-Clause
"""What files declare is compared with what they hold before memory is taken for it; refusals are one line.

Readers of SciPy, NumPy, h5py and zarr allocate what a header asks for, and raise nearly everything where
bytes are damaged. So every reader here calls `declared` first and works inside `library`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError, InputTypeError, LtclError, MemoryLimitError

EXPANSION = 1032
"""What deflate can reach, the only compression that is read."""
_FREE_ROWS = 1 << 24  # 128 MiB of pointers; a matrix of more rows must have entries to show for them
_ROWS_PER_ENTRY = 64


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


@contextlib.contextmanager
def library(what: str) -> Iterator[None]:
    """Turn whatever a library raises while it reads `what` into one FileError."""
    try:
        yield
    except (LtclError, MemoryError):
        raise
    except Exception as error:  # noqa: BLE001 - of damaged bytes, libraries raise nearly everything
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{what} is damaged or truncated: {reason!a:.150}") from None


def declared(what: str, dtype: np.dtype, shape: tuple[int, ...], most: int, least: int = 0) -> None:
    """Refuse an array whose declared bytes are not `least` .. `most`."""
    if any(type(n) is not int or n < 0 for n in shape):
        raise FileError(f"{what} is declared with the shape {shape!r:.60}; that is no array")
    nbytes = math.prod(shape) * dtype.itemsize
    if not least <= nbytes <= most:
        raise FileError(
            f"{what} is declared as {dtype.newbyteorder('=')} {shape}, {checks.size(nbytes)}, but what is "
            f"stored of it holds {'at most ' if least < most else ''}{checks.size(most)} ({most} bytes)"
        )


def real(what: str, dtype: np.dtype) -> None:
    """Refuse what is no real number; pickled objects before they are loaded."""
    if dtype.hasobject:
        raise FileError(f"{what} holds pickled Python objects, which are never loaded")
    if dtype.kind not in "fiub":
        raise FileError(f"{what} holds {dtype}; it must hold real numbers")


def matrix_shape(what: str, shape: tuple[int, ...]) -> None:
    """Refuse anything but (M, N), (1, M, N) or (3, M, N), none of them 0."""
    if not is_matrix_shape(shape):
        raise FileError(f"{what} has shape {shape}; T must be (M, N) or (3, M, N), not empty")


def is_matrix_shape(shape: tuple[int, ...]) -> bool:
    """Whether an array of `shape` can be a transport."""
    return 0 not in shape and (len(shape) == 2 or (len(shape) == 3 and shape[0] in (1, 3)))


def sparse_shape(shape: tuple[int, int], entries: int) -> None:
    """Refuse a shape that is empty, or so large that `entries` values cannot be a transport of it.

    Converting a matrix of few entries allocates all of its rows.
    """
    most = _FREE_ROWS + _ROWS_PER_ENTRY * entries
    if min(shape) < 1 or max(shape) > most:
        raise FileError(
            f"the matrix is declared as {shape} with {entries} entries; rows and columns must be 1..{most}"
        )


def floats(what: str, array: np.ndarray) -> np.ndarray:
    """Real values as float32 where that is exact by type (16 bits and fewer, float32), else as float64."""
    dtype = np.float32 if np.result_type(array.dtype, np.float32) == np.float32 else np.float64
    return np.ascontiguousarray(checks.real(what, array), dtype)


def sparse(matrix: Any) -> scipy.sparse.csr_array:
    """A matrix in any layout as checked rows of floats."""
    if matrix.ndim != 2:
        raise FileError(f"the matrix has shape {matrix.shape}; it must be (M, N)")
    if matrix.format == "bsr":
        matrix.check_format(full_check=True)  # the others are checked in `checks.csr`, or when they are made
    csr = checks.csr("the matrix", matrix)
    return scipy.sparse.csr_array((floats("data", csr.data), csr.indices, csr.indptr), shape=csr.shape)
