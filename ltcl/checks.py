# SPDX-License-Identifier: BSD-3-Clause
"""Refusals of bad input: one line each that names the argument, what it was and what it must be.

Everything here runs on the host before anything is built, uploaded or overwritten.
"""

from __future__ import annotations

import copy
import math
import operator
import os
from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import InputError, InputTypeError, MemoryLimitError


def finite(name: str, array: np.ndarray) -> np.ndarray:
    """Return `array` unchanged; refuse NaN and Inf with their number and first place."""
    # The sum is finite in almost every good case and reads the array once, without a mask.
    with np.errstate(over="ignore", invalid="ignore"):
        if array.size == 0 or np.isfinite(np.sum(array, dtype=np.float64)):
            return array
    bad = ~np.isfinite(array)
    count = int(np.count_nonzero(bad))
    if count:
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        place = first[0] if len(first) == 1 else first
        raise InputError(
            f"{name} has {count} NaN or infinite value(s), the first at {place}; all must be finite"
        )
    return array


def real(name: str, value: Any) -> np.ndarray:
    """Return `value` as an array of real numbers (no copy where it is one); refuse others."""
    if isinstance(value, np.ma.MaskedArray):  # np.asarray would drop the mask
        masked = int(np.ma.count_masked(value))
        raise InputTypeError(
            f"{name} is a masked array with {masked} masked value(s); give {name}.filled(value)"
        )
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise InputError(f"{name} is ragged; it must be a rectangular array of real numbers") from error
    if array.dtype.kind not in "fiub":
        raise InputTypeError(f"{name} holds {array.dtype}; it must hold real numbers")
    return array


def shape(name: str, array: np.ndarray, *allowed: tuple[int, ...]) -> np.ndarray:
    """Return `array` unchanged if its shape is one of `allowed`."""
    if array.shape not in allowed:
        wanted = " or ".join(str(s) for s in allowed)
        raise InputError(f"{name} has shape {array.shape}; it must be {wanted}")
    return array


def grid(name: str, value: Any, pixels: int | None = None) -> tuple[int, int]:
    """Return `value` as (h, w) of positive integers, with h * w == pixels where that is given."""
    try:
        h, w = (int(v) for v in value)
        whole = (h, w) == tuple(value)
    except (TypeError, ValueError, OverflowError):  # the last of infinity
        h = w = 0
        whole = False
    if not whole or h < 1 or w < 1:
        raise InputError(f"{name} is {value!r}; it must be two positive integers (h, w)")
    if pixels is not None and h * w != pixels:
        raise InputError(
            f"{name} is {h} x {w} = {h * w} pixels, but the matrix is for {pixels}; h * w must be {pixels}"
        )
    return h, w


def number(
    name: str,
    value: Any,
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    below: float | None = None,
) -> float:
    """Return `value` as a finite float inside the bounds given."""
    x = _as_float(value)
    limits = (
        ("above", above, operator.gt),
        ("at least", least, operator.ge),
        ("at most", most, operator.le),
        ("below", below, operator.lt),
    )
    active = [(text, bound, holds) for text, bound, holds in limits if bound is not None]
    if not math.isfinite(x) or not all(holds(x, bound) for _, bound, holds in active):
        allowed = " and ".join(f"{text} {bound:g}" for text, bound, _ in active)
        raise InputError(f"{name} is {value!r}; it must be a finite number {allowed}".rstrip())
    return x


def count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """Return `value` as an integer of at least `least` and at most `most`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name} is {value!r}; it must be a whole number of at least {least}")
    if most is not None and value > most:
        raise InputError(f"{name} is {value}; it must be at most {most}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return `value` if it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputTypeError(f"{name} is {value!r}; it must be True or False")
    return bool(value)


def one_of(name: str, value: Any, allowed: Iterable[str]) -> str:
    """Return `value` if it is one of the names `allowed`."""
    names = list(allowed)
    if value not in names:
        raise InputError(f"{name} is {value!r}; it must be one of {', '.join(names)}")
    return value


def colours(name: str, value: Any) -> int:
    """Return a number of channels: 1 for grey, 3 for RGB.

    >>> colours("channels", 2)
    Traceback (most recent call last):
    ltcl.errors.InputError: channels is 2; it must be 1 or 3
    """
    if value not in (1, 3):
        raise InputError(f"{name} is {value!r}; it must be 1 or 3")
    return value


def csr(name: str, matrix: Any) -> scipy.sparse.csr_array:
    """Return `matrix` as a checked `csr_array` with sorted, unique indices.

    A compressed matrix is checked as it stands, before SciPy touches it: SciPy itself accepts
    column indices beyond the matrix, and its conversions then read outside their arrays.
    """
    if not scipy.sparse.issparse(matrix):
        raise InputTypeError(
            f"{name} is a {type(matrix).__name__}; it must be a scipy.sparse matrix or array"
        )
    if matrix.ndim != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it must be (M, N)")
    real(name, np.zeros(0, matrix.dtype))
    if matrix.dtype == np.float16:  # SciPy computes nothing with it
        matrix = copy.copy(matrix)
        matrix.data = matrix.data.astype(np.float32)
    if matrix.format in ("csr", "csc"):
        major, minor = matrix.shape if matrix.format == "csr" else matrix.shape[::-1]
        compressed(name, matrix.indptr, matrix.indices, matrix.data, (major, minor))
        result = scipy.sparse.csr_array(matrix)
    else:
        result = scipy.sparse.csr_array(matrix)
        compressed(name, result.indptr, result.indices, result.data, matrix.shape)
    if not result.has_canonical_format:
        result = result.copy()
        result.sum_duplicates()
    return result


def compressed(
    name: str, indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, shape: tuple[int, int]
) -> None:
    """Refuse compressed rows whose pointers or indices do not describe a matrix of `shape`."""
    rows, columns = shape
    for part, array in (("indptr", indptr), ("indices", indices)):
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise InputError(f"{name}.{part} must be a vector of integers, not {array.dtype} {array.shape}")
    if data.ndim != 1:
        raise InputError(f"{name}.data has shape {data.shape}; it must be a vector")
    if len(indptr) != rows + 1 or indptr[0] != 0:
        raise InputError(
            f"{name}.indptr has {len(indptr)} entries from {indptr[0] if len(indptr) else 'none'}; "
            f"it must have {rows + 1} entries from 0"
        )
    falls = np.flatnonzero(indptr[1:] < indptr[:-1])
    if len(falls):
        raise InputError(f"{name}.indptr falls after entry {falls[0]}; row pointers must never fall")
    if indptr[-1] != len(indices) or len(indices) != len(data):
        raise InputError(
            f"{name}.indptr ends at {indptr[-1]} with {len(indices)} indices and {len(data)} values; "
            "the three must agree"
        )
    if len(indices) and (indices.min() < 0 or indices.max() >= columns):
        worst = indices.min() if indices.min() < 0 else indices.max()
        raise InputError(f"{name}.indices holds {worst}; column indices must be in 0..{columns - 1}")
    finite(f"{name}.data", data)


def host_memory() -> int:
    """Bytes of memory the host can still give, as far as the system says."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            fields = dict(line.split(":", 1) for line in file)
        return int(fields["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 1 << 62  # unknown: let the allocation itself decide


def fits_host(what: str, needed: int) -> None:
    """Refuse an allocation of `needed` bytes that the host does not have, before it is tried."""
    available = host_memory()
    if needed > available:
        raise MemoryLimitError(f"{what} needs {size(needed)}, but the host has {size(available)} free")


def size(nbytes: float) -> str:
    """Bytes as people read them: 1536 -> '1.5 KiB'."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if nbytes < 1024:
            return f"{nbytes:.4g} {unit}"
        nbytes /= 1024
    return f"{nbytes:.4g} TiB"


def upwards(error: float) -> str:
    """Two digits, rounded up, so that asking for what is shown is enough.

    >>> upwards(0.00421), upwards(0.0042), upwards(2.0)
    ('0.0043', '0.0042', '2')
    """
    if not 0.0 < error < math.inf:
        return f"{error:g}"
    shown = float(f"{error:.1e}")
    if shown < error:
        unit = 10.0 ** (math.floor(math.log10(error)) - 1)
        shown += unit
    return f"{shown:.2g}"


def _as_float(value: Any) -> float:
    if isinstance(value, (bool, str, bytes)):
        return float("nan")
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")
