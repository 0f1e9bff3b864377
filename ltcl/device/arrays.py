# SPDX-License-Identifier: BSD-3-Clause
"""Arrays on a device: a buffer with a shape and a type.

An array is (N,) for one right-hand side or (N, k) for several, row-major. `get` and `set` move
values between host and device, and `get` waits; copies within the device are queued.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.errors import InputError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device


@dataclass(frozen=True, eq=False)
class Array:
    """A buffer with a shape and a type; values move only when asked to."""

    device: Device
    buffer: Any
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def size(self) -> int:
        """Number of values."""
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Bytes of the values."""
        return self.size * self.dtype.itemsize

    @property
    def columns(self) -> int:
        """Number of right-hand sides: k of (N, k), 1 of (N,)."""
        return 1 if len(self.shape) == 1 else self.shape[1]

    def get(self) -> np.ndarray:
        """Copy the values to the host, after everything queued before has run."""
        try:
            host = np.empty(self.shape, self.dtype)
        except MemoryError as error:
            raise MemoryLimitError(
                f"the host has no room to copy {checks.size(self.nbytes)}"
            ) from error
        if host.size:
            self.device.copy(host, self.buffer)
        return host

    def set(self, values: np.ndarray) -> Array:
        """Overwrite with host values of the same shape; returns the array."""
        if values.shape != self.shape:
            raise InputError(
                f"values have shape {values.shape}; the array on the device has {self.shape}"
            )
        host = rounded(values, self.dtype)
        if host.size:
            self.device.copy(self.buffer, host)
        return self

    def rows(self, first: int, count: int) -> Array:
        """Copy `count` rows from row `first` on into a new array."""
        if not 0 <= first <= first + count <= self.shape[0]:
            raise InputError(f"rows {first} to {first + count} are not among {self.shape[0]}")
        return self.copy_rows(first, self.device.empty((count, *self.shape[1:]), self.dtype))

    def copy_rows(self, first: int, block: Array) -> Array:
        """Copy rows from row `first` on into `block`, as many as it has; returns `block`."""
        if block.size:
            offset = first * self.columns * self.dtype.itemsize
            self.device.copy(block.buffer, self.buffer, byte_count=block.nbytes, src_offset=offset)
        return block

    def set_rows(self, first: int, block: Array) -> Array:
        """Overwrite the rows from `first` on with another array of the device; returns this one."""
        last_start = self.shape[0] - block.shape[0]
        if block.shape[1:] != self.shape[1:] or not 0 <= first <= last_start:
            raise InputError(
                f"rows {first} on of an array of shape {self.shape} cannot hold {block.shape}"
            )
        if block.size:
            offset = first * self.columns * self.dtype.itemsize
            self.device.copy(self.buffer, block.buffer, byte_count=block.nbytes, dst_offset=offset)
        return self

    def copy_from(self, other: Array) -> Array:
        """Overwrite with the values of another array of the same shape; returns this one."""
        return self.set_rows(0, other)

    def copy(self) -> Array:
        """Copy the values into a new array."""
        return self.rows(0, self.shape[0])

    def like(self) -> Array:
        """Make an uninitialised array of the same shape and type."""
        return self.device.empty(self.shape, self.dtype)


def rounded(values: Any, dtype: Any) -> np.ndarray:
    """Convert `values` to a contiguous array of `dtype`.

    Raises
    ------
    InputError
        A finite value is beyond the range of `dtype`; it is not made infinite.
    MemoryLimitError
        The host has no room for the converted array.
    """
    array = checks.real("values", values)
    dtype = np.dtype(dtype)
    try:
        with np.errstate(over="raise"):
            return np.ascontiguousarray(array, dtype)
    except FloatingPointError as error:
        largest = np.finfo(dtype).max
        raise InputError(
            f"a value is beyond {dtype.name}, {largest:.3g}; scale T, its first bounce or the "
            "picture"
        ) from error
    except MemoryError as error:
        nbytes = checks.size(array.size * dtype.itemsize)
        raise MemoryLimitError(
            f"the host has no room for {nbytes} to copy from as {dtype.name}"
        ) from error


def round_inwards(lower: ArrayLike, upper: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Round bounds to float32 within the interval; to the nearest if it holds no float32.

    >>> low, high = round_inwards(0.1, 0.7)
    >>> bool(np.float32(0.7) > 0.7 >= high), bool(low >= 0.1)
    (False, True)
    """
    lower = np.asarray(lower)
    upper = np.asarray(upper)
    if lower.dtype == upper.dtype == np.float32:
        return lower, upper
    lower = lower.astype(np.float64)
    upper = upper.astype(np.float64)
    nearest_low = lower.astype(np.float32)
    nearest_high = upper.astype(np.float32)
    next_above = np.nextafter(nearest_low, np.float32(np.inf))
    next_below = np.nextafter(nearest_high, np.float32(-np.inf))
    low = np.where(nearest_low < lower, next_above, nearest_low)
    high = np.where(nearest_high > upper, next_below, nearest_high)
    is_empty = low > high
    return np.where(is_empty, nearest_low, low), np.where(is_empty, nearest_high, high)
