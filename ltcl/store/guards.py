# SPDX-License-Identifier: BSD-3-Clause
"""Checks of what a file declares, before memory is taken for it.

SciPy, NumPy, h5py and zarr allocate what a header asks for, and raise nearly everything where bytes
are damaged. So their callers call `check_declared` first, inside `about`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError, InputTypeError, LtclError, MemoryLimitError

# The most that deflate can expand a byte to; it is the only compression that is read.
EXPANSION = 1032
# Row pointers of 128 MiB; a matrix of more rows must have entries to show for them.
MAX_ROWS_WITHOUT_ENTRIES = 1 << 24
MAX_ROWS_PER_ENTRY = 64


@contextlib.contextmanager
def about(path: Any, *, reading: bool = False) -> Iterator[None]:
    """Put the name of `path` in front of each refusal in the block.

    With `reading`, any exception counts as damage of the file.
    """
    try:
        yield
    except (InputError, InputTypeError) as error:
        if isinstance(error, FileError) and str(error).startswith(str(path)):
            raise
        raise FileError(f"{path}: {error}") from error.__cause__
    except MemoryError as error:
        raise MemoryLimitError(f"{path}: {error or 'the host has no memory left'}") from None
    except OSError as error:
        if isinstance(error, LtclError):
            raise
        raise FileError(f"{path}: {_reason(error):.150}") from error
    except Exception as error:
        if isinstance(error, LtclError) or not reading:
            raise
        problem = f"is damaged or truncated: {_reason(error):.150}"
        raise FileError(f"{path}: {problem}") from error


def _reason(error: Exception) -> str:
    """Text of an exception in one line."""
    strerror = getattr(error, "strerror", None)
    if strerror:
        return strerror
    text = " ".join(str(error).split())
    return text or type(error).__name__


def check_declared(
    name: str, dtype: np.dtype, shape: tuple[int, ...], most: int, least: int = 0
) -> None:
    """Refuse an array whose declared bytes are not `least` .. `most`, or too many for the host."""
    nbytes = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or not least <= nbytes <= most:
        size = f"{dtype.newbyteorder('=')} {shape}, {checks.size(nbytes)}"
        stored = f"{checks.size(most)} ({most} bytes)"
        raise FileError(f"{name} is declared as {size}, but {stored} are stored")
    checks.fits_host(f"{name} {shape}", 2 * nbytes)


def floats(name: str, array: np.ndarray) -> np.ndarray:
    """Real values as float32 if their type fits it exactly (at most 16 bits), else as float64."""
    fits_float32 = np.result_type(array.dtype, np.float32) == np.float32
    dtype = np.float32 if fits_float32 else np.float64
    return np.ascontiguousarray(checks.real(name, array), dtype)


def sparse_floats(
    make: Callable[[], Any], shape: Sequence[int], entries: int
) -> scipy.sparse.csr_array:
    """SciPy matrix in any layout as checked rows of floats, made after its sizes are checked."""
    most = MAX_ROWS_WITHOUT_ENTRIES + MAX_ROWS_PER_ENTRY * entries
    if min(shape) < 1 or max(shape) > most:
        raise FileError(
            f"the matrix is declared as {tuple(shape)}, {entries} entries; it must be 1..{most}"
        )
    matrix = make()
    if matrix.format == "bsr":
        # Other layouts are checked in `checks.csr`, or when they are made.
        matrix.check_format(full_check=True)
    csr = checks.csr("the matrix", matrix)
    values = floats("data", csr.data)
    return scipy.sparse.csr_array((values, csr.indices, csr.indptr), shape=csr.shape)
