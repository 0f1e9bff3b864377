# SPDX-License-Identifier: BSD-3-Clause
"""Arrays on a device: (N,) one right-hand side, (N, k) several of them, row-major."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl.errors import InputError

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
        """The values on the host, once everything queued before has run."""
        host = np.empty(self.shape, self.dtype)
        if host.size:
            self.device.copy(host, self.buffer)
        return host

    def set(self, values: np.ndarray) -> Array:
        """Overwrite with host values of the same shape; returns the array."""
        if values.shape != self.shape:
            raise InputError(f"values have shape {values.shape}; the array on the device has {self.shape}")
        host = rounded(values, self.dtype)
        if host.size:
            self.device.copy(self.buffer, host)
        return self

    def rows(self, first: int, count: int) -> Array:
        """A copy of `count` rows from `first` on."""
        if not 0 <= first <= first + count <= self.shape[0]:
            raise InputError(f"rows {first} to {first + count} are not among {self.shape[0]}")
        part = self.device.empty((count, *self.shape[1:]), self.dtype)
        part._copy(self, part.nbytes, src_offset=first * self.columns * self.dtype.itemsize)
        return part

    def set_rows(self, first: int, part: Array) -> Array:
        """Overwrite the rows from `first` on with another array of the device; returns this one."""
        if part.shape[1:] != self.shape[1:] or not 0 <= first <= self.shape[0] - part.shape[0]:
            raise InputError(f"rows {first} on of an array of shape {self.shape} cannot hold {part.shape}")
        self._copy(part, part.nbytes, dst_offset=first * self.columns * self.dtype.itemsize)
        return self

    def copy_from(self, other: Array) -> Array:
        """Overwrite with the values of another array of the same shape; returns this one."""
        if other.shape != self.shape:
            raise InputError(f"cannot copy an array of shape {other.shape} into one of {self.shape}")
        self._copy(other, self.nbytes)
        return self

    def _copy(self, of: Array, nbytes: int, **offsets: int) -> None:
        if nbytes:
            self.device.copy(self.buffer, of.buffer, byte_count=nbytes, **offsets)

    def copy(self) -> Array:
        """Another array with the same values."""
        return self.like().copy_from(self)

    def like(self) -> Array:
        """An uninitialised array of the same shape and type."""
        return self.device.empty(self.shape, self.dtype)


def rounded(values: Any, dtype: Any) -> np.ndarray:
    """`values` as a contiguous array of `dtype`; numbers beyond its range are refused, not made infinite."""
    try:
        with np.errstate(over="raise"):
            return np.ascontiguousarray(values, dtype=dtype)
    except FloatingPointError as error:
        name, most = np.dtype(dtype).name, np.finfo(dtype).max
        raise InputError(f"a value is beyond {name}, the largest of which is {most:.3g}; rescale") from error
