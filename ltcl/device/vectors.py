# SPDX-License-Identifier: BSD-3-Clause
"""Arrays on a device, and what a solver does between two products: fill, axpby, scaling, dot, norm.

An array is (N,) for one right-hand side or (N, k) for several, row-major. Only what gives numbers
to the host waits: `get`, `dot`, `norm`, `norms`. Sums are trees over fixed slices: the same bits at
every call.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device
    from ltcl.device.kernels import Kernel

# The argument `pairs` of vector_dots: 4 bits a pair, here arrays 0 and 1.
_DOT_OF_A_AND_B = 0b0100
_VALUES = {
    True: 128,
    False: 8,
}  # of an item of a CPU or not, before a reduction takes another group


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
        """A copy of `count` rows from `first` on."""
        if not 0 <= first <= first + count <= self.shape[0]:
            raise InputError(f"rows {first} to {first + count} are not among {self.shape[0]}")
        block = self.device.empty((count, *self.shape[1:]), self.dtype)
        if block.size:
            offset = first * self.columns * self.dtype.itemsize
            self.device.copy(block.buffer, self.buffer, byte_count=block.nbytes, src_offset=offset)
        return block

    def set_rows(self, first: int, block: Array) -> Array:
        """Overwrite the rows from `first` on with another array of the device; returns this one."""
        if block.shape[1:] != self.shape[1:] or not 0 <= first <= self.shape[0] - block.shape[0]:
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
        """Another array with the same values."""
        return self.rows(0, self.shape[0])

    def like(self) -> Array:
        """An uninitialised array of the same shape and type."""
        return self.device.empty(self.shape, self.dtype)


def rounded(values: Any, dtype: Any) -> np.ndarray:
    """`values` as a contiguous array of `dtype`; numbers beyond its range are refused, not made infinite."""
    array, dtype = checks.real("values", values), np.dtype(dtype)
    try:
        with np.errstate(over="raise"):
            return np.ascontiguousarray(array, dtype)
    except FloatingPointError as error:
        most = f"{np.finfo(dtype).max:.3g}; scale T, its first bounce or the picture"
        raise InputError(f"a value is beyond {dtype.name}, {most}") from error
    except MemoryError as error:
        nbytes = checks.size(array.size * dtype.itemsize)
        raise MemoryLimitError(
            f"the host has no room for {nbytes} to copy from as {dtype.name}"
        ) from error


def fill(x: Array, value: float) -> Array:
    """x = value everywhere."""
    return _elementwise(x, "vector_fill", value=value)


def axpby(a: float, x: Array, b: float, y: Array, out: Array) -> Array:
    """out = a x + b y; `out` may be `x` or `y`."""
    _same_shape(x, y, out)
    return _elementwise(out, "vector_axpby", a=a, x=x, b=b, y=y)


def axpy(a: float, x: Array, y: Array) -> Array:
    """y = a x + y."""
    return axpby(a, x, 1.0, y, y)


def scale_rows(d: Array, x: Array, out: Array) -> Array:
    """out = diag(d) x with d (N,) and x (N,) or (N, k); `out` may be `x`."""
    _same_shape(x, out)
    if d.shape != x.shape[:1]:
        raise InputError(f"the diagonal has shape {d.shape}; it must be {x.shape[:1]}")
    return _elementwise(out, "vector_scale_rows", k=x.columns, d=d, x=x)


def dot(x: Array, y: Array) -> np.ndarray:
    """<x_c, y_c> of every column c, as (k,) float64; waits for the device."""
    _same_shape(x, y)
    sums = x.device.empty((_plan("vector_dots", x).groups, x.columns))
    _queue_partial_dots(x, y, sums, 0)
    return sums.get().sum(axis=0, dtype=np.float64)


def norm(x: Array) -> np.ndarray:
    """Euclidean norm of every column, as (k,) float64; waits for the device."""
    return np.sqrt(dot(x, x))


def norms(*xs: Array) -> np.ndarray:
    """Euclidean norms of the columns of each x, as (len(xs), k) float64; waits once for all."""
    out = xs[0].device.empty((len(xs), xs[0].columns))
    for slot, x in enumerate(xs):
        queue_dot(x, x, out, slot)
    return np.sqrt(out.get().astype(np.float64))


def queue_dot(x: Array, y: Array, out: Array, slot: int) -> None:
    """Row `slot` of `out` (slots, k) = <x_c, y_c> of every column c; does not wait."""
    _same_shape(x, y)
    groups = _plan("vector_dots", x).groups
    if groups == 1:
        _queue_partial_dots(x, y, out, slot * x.columns)
        return
    partials = x.device.empty((1, groups, x.columns))
    _queue_partial_dots(x, y, partials, 0)
    queue_sum_partials(partials, 1, out, slot)


def _queue_partial_dots(x: Array, y: Array, partials: Array, first: int) -> None:
    """Sums of x * y by column and group, from value `first` of `partials` on."""
    _reduce(
        "vector_dots",
        x,
        first=first,
        pairs=_DOT_OF_A_AND_B,
        weighted=0,
        weights=x,  # not read
        a=x,
        b=y,
        c=y,  # not read
        partials=partials,
    )


def queue_step(
    p: Array, x: Array, r: Array, d: Array, keep: float, gain: float, partials: Array, slot: int
) -> None:
    """x += d, r -= p = S d, d = keep d + gain r, in one launch; does not wait.

    The squares of the new r go, added up, to row `slot` of `partials` (slots, step_groups(x), k).
    """
    _same_shape(p, x, r, d)
    first = slot * step_groups(x) * x.columns
    vectors = {"p": p, "x": x, "r": r, "d": d}
    _reduce("vector_step", x, keep=keep, gain=gain, first=first, squares=partials, **vectors)


def step_groups(x: Array) -> int:
    """Into how many partial sums a column `queue_step` adds up the squares of a vector like `x`."""
    return _plan("vector_step", x).groups


def queue_sum_partials(partials: Array, slots: int, out: Array, slot: int = 0) -> None:
    """Rows slot .. slot + slots - 1 of `out` = the first of `partials` (slots, groups, k), added up."""
    first = slot * out.columns
    _reduce("vector_sums", partials, across=slots, sums=partials, out=out, first=first)


class _Plan(NamedTuple):
    """A kernel that sums over the rows of (rows, k) in `groups` work-groups of `group` items."""

    kernel: Kernel
    rows: int
    k: int
    groups: int
    group: int


def _plan(name: str, x: Array) -> _Plan:
    """For vectors (rows,) or (rows, k), or for partial sums (slots, rows, k), made once for each size."""
    device, (rows, k) = x.device, (*x.shape, 1)[:2] if len(x.shape) < 3 else x.shape[1:]
    if (name, rows, k) not in device.reductions:
        kernel = kernel_of(device, name)
        group = kernel.group((16 if k <= 16 else 64) if device.is_cpu else 256)
        most = max(
            64, 4 * device.compute_units
        )  # enough for a large GPU, few enough for one last group
        groups = 1 if name == "vector_sums" else -(-rows * k // (group * _VALUES[device.is_cpu]))
        device.reductions[name, rows, k] = _Plan(kernel, rows, k, max(1, min(groups, most)), group)
    return device.reductions[name, rows, k]


def _reduce(name: str, like: Array, /, *, across: int = 1, **arguments: float | Array) -> None:
    kernel, rows, k, groups, group = _plan(name, like)
    items = (groups * group, across, -(-k // group))
    scratch = like.device.local(group)
    kernel(items, (group, 1, 1), rows=rows, k=k, scratch=scratch, **arguments)


def _elementwise(out: Array, name: str, /, **arguments: float | Array) -> Array:
    kernel_of(out.device, name)(out.size, 256, count=out.size, out=out, **arguments)
    return out


def kernel_of(device: Device, name: str) -> Kernel:
    """A kernel of a file that includes `common/columns.h`."""
    return device.kernel(name.partition("_")[0], name, **({} if device.is_cpu else {"ADJACENT": 0}))


def _same_shape(*arrays: Array) -> None:
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise InputError(f"vectors of different shapes {sorted(shapes)} cannot be combined")
