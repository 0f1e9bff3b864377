# SPDX-License-Identifier: BSD-3-Clause
"""Checks of arguments: bad input is refused before anything is built.

Each error is one line that names the argument, what it was and what it must be.
"""

from __future__ import annotations

import contextlib
import copy
import decimal
import functools
import importlib
import inspect
import math
import operator
import os
import textwrap
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import numpy as np
import scipy.sparse

from ltcl.errors import InputError, InputTypeError, LtclError, MemoryLimitError
from ltcl.interop.arrays import kind_of
from ltcl.interop.calls import Call, Differentiable, without_derivative

BOUNDS = {
    "above": ("above", operator.gt),
    "least": ("at least", operator.ge),
    "most": ("at most", operator.le),
    "below": ("below", operator.lt),
}
TWO_DIGITS_UPWARDS = decimal.Context(prec=2, rounding=decimal.ROUND_CEILING)
UNLIMITED = 1 << 62  # bytes

P = ParamSpec("P")
R = TypeVar("R")


def takes_arrays(
    *names: str, differentiable: Differentiable | None = None
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a public call: the arguments of these names may be arrays of other libraries.

    Results are then of the kind of the first of these. Calls with NumPy's arrays run as they are.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        places = [(name, list(signature.parameters).index(name)) for name in names]

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            arrays = {}
            for name, place in places:
                value = args[place] if place < len(args) else kwargs.get(name)
                if kind_of(type(value)) is not None:
                    arrays[name] = value
            if not arrays:
                return function(*args, **kwargs)
            return Call(
                function=function,
                arguments=signature.bind(*args, **kwargs),
                arrays=arrays,
                read=real,
                differentiable=differentiable,
            ).run()

        return call

    return decorate


def finite(name: str, array: np.ndarray) -> np.ndarray:
    """Return `array` unchanged; refuse NaN and Inf with their number and first place."""
    # The sum is finite in almost every good case and reads the array once, without a mask.
    with np.errstate(over="ignore", invalid="ignore"):
        if array.size == 0 or np.isfinite(np.sum(array)):
            return array
    bad = np.argwhere(~np.isfinite(array)).tolist()
    if not bad:
        return array
    place = ""
    if array.ndim == 1:
        place = f", the first at {bad[0][0]}"
    elif array.ndim > 1:
        place = f", the first at {tuple(bad[0])}"
    raise InputError(f"{name} has {len(bad)} NaN or infinite value(s){place}; all must be finite")


def real(name: str, value: Any) -> np.ndarray:
    """Return `value` as an array of real numbers (no copy where it is one); refuse others."""
    if isinstance(value, (str, os.PathLike)):
        advice = "read a picture with ltcl.images.read, a transport with ltcl.load"
        raise InputTypeError(f"{name} is the text {str(value)!r}; it must be an array: {advice}")
    unmasked(name, value)
    untracked(name, value)
    kind = kind_of(type(value))
    try:
        array = np.asarray(value) if kind is None else kind.read(value)
    except ValueError as error:
        raise InputError(
            f"{name} is ragged; it must be a rectangular array of real numbers"
        ) from error
    except (BufferError, RuntimeError, TypeError) as error:
        # Tensors that are sparse, without numbers, or in a type that NumPy lacks.
        advice = "give it as a NumPy array" if kind is None else kind.unreadable_advice(value)
        reason = str(error).partition("\n")[0].rstrip(".")
        raise InputTypeError(
            f"{name} is a {type(value).__name__} that NumPy cannot read ({reason}); {advice}"
        ) from error
    if array.dtype.kind not in "fiub":
        content = "is None" if value is None else f"holds {array.dtype}"
        raise InputTypeError(f"{name} {content}; it must hold real numbers")
    return array


def untracked(name: str, value: Any) -> None:
    """Refuse an array whose derivative is asked for: it would be lost."""
    kind = kind_of(type(value))
    if kind is not None and kind.is_tracked(value):
        raise without_derivative(name, value)


def unmasked(name: str, value: Any) -> None:
    """Refuse masked values in an array or a list of rows; np.asarray would drop the mask."""
    rows = value if isinstance(value, (list, tuple)) else [value]
    masked = 0
    for row in rows:
        if isinstance(row, np.ma.MaskedArray):
            masked += int(np.ma.count_masked(row))
    if masked:
        raise InputTypeError(
            f"{name} has {masked} masked value(s); fill them first, as with .filled(0)"
        )


def shape(name: str, array: np.ndarray, *allowed: tuple[int, ...]) -> np.ndarray:
    """Return `array` unchanged if its shape is one of `allowed`."""
    if array.shape not in allowed:
        shapes = " or ".join(map(str, allowed))
        raise InputError(f"{name} has shape {array.shape}; it must be {shapes}")
    return array


def grid(name: str, value: Any, pixels: int | None = None) -> tuple[int, int]:
    """Return `value` as (h, w) of positive integers, with h * w == pixels where that is given."""
    h = w = 0
    # An infinite size overflows.
    with contextlib.suppress(TypeError, ValueError, OverflowError):
        h, w = (int(size) for size in value)
    if h < 1 or w < 1 or (h, w) != tuple(value):
        raise InputError(f"{name} is {shown(value)}; it must be two positive integers (h, w)")
    if pixels is not None and h * w != pixels:
        raise InputError(f"{name} is {h} x {w} = {h * w} pixels; h * w must be {pixels}")
    return h, w


def number(name: str, value: Any, **bounds: float) -> float:
    """Return `value` as a finite float; bounds are above=, least=, most= and below=."""
    if not isinstance(value, (int, float, np.generic)):
        untracked(name, value)
    x = math.nan
    is_scalar = not isinstance(value, (bool, str, bytes)) and not getattr(value, "ndim", 0)
    if is_scalar:
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            x = float(value)
    is_allowed = math.isfinite(x)
    conditions = []
    for side, bound in bounds.items():
        text, holds = BOUNDS[side]
        conditions.append(f"{text} {bound:g}")
        is_allowed = is_allowed and holds(x, bound)
    if not is_allowed:
        allowed = " and ".join(conditions)
        raise InputError(f"{name} is {shown(value)}; it must be a finite number {allowed}".rstrip())
    return x


def interval(name: str, value: Any) -> tuple[float, float]:
    """Return `value` as (low, high), finite and in this order."""
    try:
        low, high = value
    except (TypeError, ValueError):
        raise InputError(f"{name} is {shown(value)}; it must be (low, high)") from None
    low = number(f"{name}[0]", low)
    high = number(f"{name}[1]", high)
    if low >= high:
        raise InputError(f"{name} is {shown(value)}; it must be (low, high) with low below high")
    return low, high


def count(name: str, value: Any, *, least: int = 1, most: int | None = None) -> int:
    """Return `value` as an integer of at least `least` and at most `most`."""
    is_whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not is_whole or value < least:
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
        names = ", ".join(map(str, choices))
        raise InputError(f"{name} is {value!r}; it must be one of {names}")
    return value


def csr(name: str, matrix: Any) -> scipy.sparse.csr_array:
    """Return `matrix` as a checked `csr_array` with sorted, unique indices."""
    if not scipy.sparse.issparse(matrix):
        kind = type(matrix).__name__
        raise InputTypeError(f"{name} is a {kind}; it must be a scipy.sparse array")
    if matrix.ndim != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it must be (M, N)")
    real(name, np.zeros(0, matrix.dtype))
    if matrix.dtype == np.float16:  # SciPy computes nothing with it
        matrix = copy.copy(matrix)
        matrix.data = matrix.data.astype(np.float32)
    if matrix.format not in ("csr", "csc"):
        matrix = scipy.sparse.csr_array(matrix)
    # The arrays are checked before SciPy converts them: it may read outside of arrays that lie.
    compressed_shape = matrix.shape if matrix.format == "csr" else matrix.shape[::-1]
    compressed(name, matrix.indptr, matrix.indices, matrix.data, compressed_shape)
    result = scipy.sparse.csr_array(matrix)
    if not result.has_canonical_format:
        result = result.copy()
        result.sum_duplicates()
    return result


def compressed(
    name: str, indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, shape: tuple[int, int]
) -> None:
    """Refuse compressed rows that are no matrix of `shape`.

    SciPy's `check_format` takes some of these.
    """
    rows, columns = shape
    _check_vector(f"{name}.indptr", indptr, "iu", "a vector of integers")
    _check_vector(f"{name}.indices", indices, "iu", "a vector of integers")
    _check_vector(f"{name}.data", data, "fiubc", "a vector")
    if len(indptr) != rows + 1 or indptr[0] != 0 or np.any(indptr[1:] < indptr[:-1]):
        first = indptr[0] if len(indptr) else "none"
        raise InputError(
            f"{name}.indptr has {len(indptr)} entries from {first}; "
            f"it must have {rows + 1}, from 0, and must never fall"
        )
    if indptr[-1] != len(indices) or len(indices) != len(data):
        counts = f"{len(indices)} indices and {len(data)} values"
        raise InputError(f"{name}.indptr ends at {indptr[-1]} with {counts}; the three must agree")
    if len(indices) and (indices.min() < 0 or indices.max() >= columns):
        worst = indices.min() if indices.min() < 0 else indices.max()
        raise InputError(
            f"{name}.indices holds {worst}; column indices must be in 0..{columns - 1}"
        )
    finite(f"{name}.data", data)


def _check_vector(name: str, array: np.ndarray, kinds: str, expected: str) -> None:
    if array.ndim != 1 or array.dtype.kind not in kinds:
        raise InputError(f"{name} has shape {array.shape}, {array.dtype}; it must be {expected}")


def host_memory() -> int:
    """Bytes of memory that the host can still give, by the system and limits of this process."""
    return min(_memory_of_system(), _memory_within_limits())


def _memory_of_system() -> int:
    """Bytes that the system has free; unlimited if unknown, as the allocation itself decides."""
    with contextlib.suppress(OSError, KeyError, ValueError):
        with open("/proc/meminfo", encoding="ascii") as file:
            fields = dict(line.split(":", 1) for line in file)
        return int(fields["MemAvailable"].split()[0]) * 1024
    with contextlib.suppress(AttributeError, OSError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return UNLIMITED


def _memory_within_limits() -> int:
    """Bytes that the limits of this process (`ulimit`) leave."""
    available = UNLIMITED
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # not on Windows

        # Columns of /proc/self/statm: all addresses; data, without files.
        for kind, column in ((resource.RLIMIT_AS, 0), (resource.RLIMIT_DATA, 5)):
            limit, _ = resource.getrlimit(kind)
            if limit == resource.RLIM_INFINITY:
                continue
            with open("/proc/self/statm", encoding="ascii") as file:
                pages = int(file.read().split()[column])
            used = pages * os.sysconf("SC_PAGE_SIZE")
            available = min(available, max(limit - used, 0))
    return available


def fits_host(what: str, needed: int, most: int = UNLIMITED) -> None:
    """Refuse to allocate `needed` bytes beyond `most` or beyond what the host has."""
    if needed > most:
        raise MemoryLimitError(f"{what} needs {size(needed)}; it may take at most {size(most)}")
    available = host_memory()
    if needed > available:
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
    rounded = TWO_DIGITS_UPWARDS.create_decimal(repr(float(error)))
    return f"{float(rounded):.2g}"


def load_extra(module: str, extra: str, user: str, kind: type[LtclError] = InputError) -> Any:
    """Import a module that an extra of ltcl brings; an error of that kind says who needs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise kind(missing_extra(module, extra, user, error)) from None


def missing_extra(module: str, extra: str, user: str, error: ImportError) -> str:
    """Say in one line which module is missing, who needs it, and how it is installed."""
    cause = " ".join(str(error).split())
    return f'{user} needs {module} ({cause}); install it with python -m pip install "ltcl[{extra}]"'
