# SPDX-License-Identifier: BSD-3-Clause
"""Refusals of bad input before anything is built: one line with argument, value and what it must be."""

from __future__ import annotations

import contextlib
import copy
import decimal
import math
import operator
import os
import textwrap
from collections.abc import Iterable
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import InputError, InputTypeError, MemoryLimitError

_BOUNDS = {
    "above": ("above", operator.gt),
    "least": ("at least", operator.ge),
    "most": ("at most", operator.le),
    "below": ("below", operator.lt),
}
_UPWARDS = decimal.Context(prec=2, rounding=decimal.ROUND_CEILING)


def finite(name: str, array: np.ndarray) -> np.ndarray:
    """Return `array` unchanged; refuse NaN and Inf with their number and first place."""
    # The sum is finite in almost every good case and reads the array once, without a mask.
    with np.errstate(over="ignore", invalid="ignore"):
        if array.size == 0 or np.isfinite(np.sum(array)):
            return array
    bad = np.argwhere(~np.isfinite(array)).tolist()
    if bad:
        place = (
            f", the first at {bad[0][0] if array.ndim == 1 else tuple(bad[0])}"
            if array.ndim
            else ""
        )
        raise InputError(
            f"{name} has {len(bad)} NaN or infinite value(s){place}; all must be finite"
        )
    return array


def real(name: str, value: Any) -> np.ndarray:
    """Return `value` as an array of real numbers (no copy where it is one); refuse others."""
    if isinstance(value, (str, os.PathLike)):
        reading = "read a picture with ltcl.images.read, a transport with ltcl.load"
        raise InputTypeError(f"{name} is the text {str(value)!r}; it must be an array: {reading}")
    unmasked(name, value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise InputError(
            f"{name} is ragged; it must be a rectangular array of real numbers"
        ) from error
    if array.dtype.kind not in "fiub":
        wrong = "is None" if value is None else f"holds {array.dtype}"
        raise InputTypeError(f"{name} {wrong}; it must hold real numbers")
    return array


def unmasked(name: str, value: Any) -> None:
    """Refuse an array with masked values, or a list of such rows: np.asarray would drop the mask."""
    rows = value if isinstance(value, (list, tuple)) else [value]
    if masked := sum(
        int(np.ma.count_masked(row)) for row in rows if isinstance(row, np.ma.MaskedArray)
    ):
        raise InputTypeError(
            f"{name} has {masked} masked value(s); fill them first, as with .filled(0)"
        )


def shape(name: str, array: np.ndarray, *allowed: tuple[int, ...]) -> np.ndarray:
    """Return `array` unchanged if its shape is one of `allowed`."""
    if array.shape not in allowed:
        raise InputError(
            f"{name} has shape {array.shape}; it must be {' or '.join(map(str, allowed))}"
        )
    return array


def grid(name: str, value: Any, pixels: int | None = None) -> tuple[int, int]:
    """Return `value` as (h, w) of positive integers, with h * w == pixels where that is given."""
    h = w = 0
    with contextlib.suppress(TypeError, ValueError, OverflowError):  # the last of infinity
        h, w = (int(v) for v in value)
    if h < 1 or w < 1 or (h, w) != tuple(value):
        raise InputError(f"{name} is {shown(value)}; it must be two positive integers (h, w)")
    if pixels is not None and h * w != pixels:
        raise InputError(f"{name} is {h} x {w} = {h * w} pixels; h * w must be {pixels}")
    return h, w


def number(name: str, value: Any, **bounds: float) -> float:
    """Return `value` as a finite float; bounds are above=, least=, most= and below=."""
    x = math.nan
    if not isinstance(value, (bool, str, bytes)) and not getattr(value, "ndim", 0):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            x = float(value)
    limits = [(*_BOUNDS[side], bound) for side, bound in bounds.items()]
    if not math.isfinite(x) or not all(holds(x, bound) for _, holds, bound in limits):
        allowed = " and ".join(f"{text} {bound:g}" for text, _, bound in limits)
        raise InputError(f"{name} is {shown(value)}; it must be a finite number {allowed}".rstrip())
    return x


def interval(name: str, value: Any) -> tuple[float, float]:
    """Return `value` as (low, high), finite and in this order."""
    try:
        low, high = value
    except (TypeError, ValueError):
        raise InputError(f"{name} is {shown(value)}; it must be (low, high)") from None
    low, high = number(f"{name}[0]", low), number(f"{name}[1]", high)
    if low >= high:
        raise InputError(f"{name} is {shown(value)}; it must be (low, high) with low below high")
    return low, high


def count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """Return `value` as an integer of at least `least` and at most `most`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"{name} is {shown(value)}; it must be a whole number of at least {least}")
    if most is not None and value > most:
        raise InputError(f"{name} is {value}; it must be at most {most}")
    return int(value)


def flag(name: str, value: Any) -> bool:
    """Return `value` if it is True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputTypeError(f"{name} is {shown(value)}; it must be True or False")
    return bool(value)


def one_of(name: str, value: Any, allowed: Iterable[Any]) -> Any:
    """Return `value` if it is one of `allowed`."""
    choices = list(allowed)
    if getattr(value, "ndim", 0) or value not in choices:
        raise InputError(f"{name} is {value!r}; it must be one of {', '.join(map(str, choices))}")
    return value


def csr(name: str, matrix: Any) -> scipy.sparse.csr_array:
    """Return `matrix` as a checked `csr_array` with sorted, unique indices."""
    if not scipy.sparse.issparse(matrix):
        raise InputTypeError(
            f"{name} is a {type(matrix).__name__}; it must be a scipy.sparse array"
        )
    if matrix.ndim != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it must be (M, N)")
    real(name, np.zeros(0, matrix.dtype))
    if matrix.dtype == np.float16:  # SciPy computes nothing with it
        matrix = copy.copy(matrix)
        matrix.data = matrix.data.astype(np.float32)
    if matrix.format not in ("csr", "csc"):
        matrix = scipy.sparse.csr_array(matrix)
    shape = matrix.shape if matrix.format == "csr" else matrix.shape[::-1]
    compressed(
        name, matrix.indptr, matrix.indices, matrix.data, shape
    )  # SciPy may read outside of arrays
    result = scipy.sparse.csr_array(matrix)
    if not result.has_canonical_format:
        result = result.copy()
        result.sum_duplicates()
    return result


def compressed(
    name: str, indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, shape: tuple[int, int]
) -> None:
    """Refuse compressed rows of no matrix of `shape`, some of which SciPy's `check_format` takes."""
    rows, columns = shape
    for what, array in (("indptr", indptr), ("indices", indices), ("data", data)):
        kinds, of = ("iu", " of integers") if what != "data" else ("fiubc", "")
        if array.ndim != 1 or array.dtype.kind not in kinds:
            raise InputError(
                f"{name}.{what} has shape {array.shape}, {array.dtype}; it must be a vector{of}"
            )
    if len(indptr) != rows + 1 or indptr[0] != 0 or np.any(indptr[1:] < indptr[:-1]):
        start = f"{len(indptr)} entries from {indptr[0] if len(indptr) else 'none'}"
        raise InputError(f"{name}.indptr has {start}; it must have {rows + 1}, and must never fall")
    if indptr[-1] != len(indices) or len(indices) != len(data):
        counts = f"{len(indices)} indices and {len(data)} values"
        raise InputError(f"{name}.indptr ends at {indptr[-1]} with {counts}; the three must agree")
    if len(indices) and (indices.min() < 0 or indices.max() >= columns):
        worst = indices.min() if indices.min() < 0 else indices.max()
        raise InputError(
            f"{name}.indices holds {worst}; column indices must be in 0..{columns - 1}"
        )
    finite(f"{name}.data", data)


def host_memory() -> int:
    """Bytes of memory the host can still give, as far as the system and a limit of this process say."""
    available = 1 << 62  # unknown: let the allocation itself decide
    with contextlib.suppress(AttributeError, OSError, ValueError):
        available = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with (
        contextlib.suppress(OSError, KeyError, ValueError),
        open("/proc/meminfo", encoding="ascii") as file,
    ):
        fields = dict(line.split(":", 1) for line in file)
        available = int(fields["MemAvailable"].split()[0]) * 1024
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # not on Windows

        for kind, column in (
            (resource.RLIMIT_AS, 0),
            (resource.RLIMIT_DATA, 5),
        ):  # addresses; without files
            limit, _ = resource.getrlimit(kind)
            if limit != resource.RLIM_INFINITY:
                with open("/proc/self/statm", encoding="ascii") as file:
                    used = int(file.read().split()[column]) * os.sysconf("SC_PAGE_SIZE")
                available = min(available, max(limit - used, 0))
    return available


def fits_host(what: str, needed: int, most: int = 1 << 62) -> None:
    """Refuse an allocation of `needed` bytes beyond `most` or what the host has, before it is tried."""
    if needed > most:
        raise MemoryLimitError(f"{what} needs {size(needed)}; it may take at most {size(most)}")
    if needed > (available := host_memory()):
        raise MemoryLimitError(
            f"{what} needs {size(needed)}, but the host has {size(available)} free"
        )


def shown(value: Any) -> str:
    """A value in one short line; of arrays the shape."""
    if getattr(value, "ndim", 0):
        return f"an array of shape {value.shape}"
    return textwrap.shorten(repr(value), 100, placeholder="...")


def size(nbytes: float) -> str:
    """Bytes as people read them: 1536 -> '1.5 KiB'."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if nbytes < 1024:
            return f"{nbytes:.4g} {unit}"
        nbytes /= 1024
    return f"{nbytes:.4g} TiB"


def upwards(error: float) -> str:
    """Two digits, rounded up: 0.00421 -> '0.0043'."""
    return f"{float(_UPWARDS.create_decimal(repr(float(error)))):.2g}"
