# SPDX-License-Identifier: BSD-3-Clause
"""Arithmetic between two products: fill, axpby, scaling, dot products, norms, steps.

Arrays are (N,) or (N, k). Only `dot`, `norm` and `norms` wait, as they give numbers to the host.
Sums are trees over fixed slices of the rows, in two launches: the same bits at every call.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ltcl.device.arrays import Array
from ltcl.errors import InputError

if TYPE_CHECKING:
    from ltcl.device.device import Device
    from ltcl.device.kernels import Kernel, Launch

# Work-items that share a column of a reduction. On a CPU each is a stream: a few of neighbouring
# columns, or of many columns.
GPU_GROUP = 256
CPU_GROUP = 16
CPU_GROUP_OF_MANY_COLUMNS = 64
# Values that each work-item adds up before a reduction takes another group.
GPU_VALUES_PER_ITEM = 8
CPU_VALUES_PER_ITEM = 128
# Groups of a reduction: enough for a large GPU, and few enough for one last group.
MIN_GROUP_LIMIT = 64


def fill(x: Array, value: float) -> Array:
    """Set x = value everywhere."""
    bind_fill(x, value)()
    return x


def bind_fill(x: Array, value: float) -> Launch:
    """The launch of `fill`, to be queued again and again."""
    return _bind_elementwise(x, "vector_fill", value=value)


def axpby(a: float, x: Array, b: float, y: Array, out: Array) -> Array:
    """Set out = a x + b y; `out` may be `x` or `y`."""
    bind_axpby(a, x, b, y, out)()
    return out


def bind_axpby(a: float, x: Array, b: float, y: Array, out: Array) -> Launch:
    """The launch of `axpby`, to be queued again and again."""
    _same_shape(x, y, out)
    return _bind_elementwise(out, "vector_axpby", a=a, x=x, b=b, y=y)


def axpy(a: float, x: Array, y: Array) -> Array:
    """Set y = a x + y."""
    return axpby(a, x, 1.0, y, y)


def scale_rows(d: Array, x: Array, out: Array) -> Array:
    """Set out = diag(d) x with d (N,) and x (N,) or (N, k); `out` may be `x`."""
    bind_scale_rows(d, x, out)()
    return out


def bind_scale_rows(d: Array, x: Array, out: Array) -> Launch:
    """The launch of `scale_rows`, to be queued again and again."""
    _same_shape(x, out)
    if d.shape != x.shape[:1]:
        raise InputError(f"the diagonal has shape {d.shape}; it must be {x.shape[:1]}")
    return _bind_elementwise(out, "vector_scale_rows", k=x.columns, d=d, x=x)


def dot(x: Array, y: Array) -> np.ndarray:
    """Inner product <x_c, y_c> of every column c, as (k,) float64; waits for the device."""
    _same_shape(x, y)
    partials = x.device.empty((_plan("vector_dots", x).groups, x.columns))
    _queue_partial_dots(x, y, partials, 0)
    return partials.get().sum(axis=0, dtype=np.float64)


def norm(x: Array) -> np.ndarray:
    """Euclidean norm of every column, as (k,) float64; waits for the device."""
    return np.sqrt(dot(x, x))


def norms(*xs: Array) -> np.ndarray:
    """Euclidean norms of the columns of each x, as (len(xs), k) float64; waits once for all."""
    squares = xs[0].device.empty((len(xs), xs[0].columns))
    for slot, x in enumerate(xs):
        queue_dot(x, x, squares, slot)
    return np.sqrt(squares.get().astype(np.float64))


def queue_dot(x: Array, y: Array, out: Array, slot: int) -> None:
    """Set row `slot` of `out` (slots, k) to <x_c, y_c> of every column c; does not wait."""
    _same_shape(x, y)
    groups = _plan("vector_dots", x).groups
    if groups == 1:
        _queue_partial_dots(x, y, out, slot * x.columns)
        return
    partials = x.device.empty((1, groups, x.columns))
    _queue_partial_dots(x, y, partials, 0)
    queue_sum_partials(partials, 1, out, slot)


def queue_step(
    p: Array, x: Array, r: Array, d: Array, keep: float, gain: float, partials: Array, slot: int
) -> None:
    """Queue x += d, r -= p = S d, d = keep d + gain r, as one launch; does not wait.

    The squares of the new r go, added up, to row `slot` of `partials` (slots, step_groups(x), k).
    """
    _same_shape(p, x, r, d)
    _reduce(
        "vector_step",
        x,
        keep=keep,
        gain=gain,
        p=p,
        x=x,
        r=r,
        d=d,
        squares=partials,
        first=slot * step_groups(x) * x.columns,
    )


def step_groups(x: Array) -> int:
    """Number of partial sums of a column in which `queue_step` leaves the squares of r."""
    return _plan("vector_step", x).groups


def queue_sum_partials(partials: Array, slots: int, out: Array, slot: int = 0) -> None:
    """Add up the first `slots` of `partials` (slots, groups, k) over the groups; does not wait.

    The sums go to the rows of `out` from `slot` on.
    """
    first = slot * out.columns
    _reduce("vector_sums", partials, across=slots, sums=partials, out=out, first=first)


def dot_pairs(*pairs: str) -> int:
    """Argument `pairs` of the kernel vector_dots: which of its arrays a, b, c are multiplied.

    >>> bin(dot_pairs("ab")), bin(dot_pairs("ba", "bb"))
    ('0b100', '0b1010001')
    """
    code = 0
    for number, (left, right) in enumerate(pairs):
        code |= ("abc".index(left) + 4 * "abc".index(right)) << (4 * number)
    return code


def kernel_of(device: Device, name: str, **defines: int | str) -> Kernel:
    """A kernel of a file that includes `common/columns.h`, with the defines of that file."""
    file = name.partition("_")[0]
    if device.is_cpu:
        return device.kernel(file, name, **defines)
    return device.kernel(file, name, ADJACENT=0, **defines)


DOT_OF_A_AND_B = dot_pairs("ab")


def _queue_partial_dots(x: Array, y: Array, partials: Array, first: int) -> None:
    """Sums of x * y by column and group, from value `first` of `partials` on."""
    _reduce(
        "vector_dots",
        x,
        first=first,
        pairs=DOT_OF_A_AND_B,
        a=x,
        b=y,
        c=y,  # not read
        weighted=0,
        weights=x,  # not read
        partials=partials,
    )


class _Plan(NamedTuple):
    """A kernel that sums over the rows of (rows, k) in `groups` work-groups of `group` items."""

    kernel: Kernel
    rows: int
    k: int
    groups: int
    group: int


def _plan(name: str, x: Array) -> _Plan:
    """Plan of a reduction over vectors (rows,), (rows, k), or partial sums (slots, rows, k).

    It is made once for each kernel and size, and kept with the device.
    """
    device = x.device
    rows, k = _rows_and_columns(x)
    key = name, rows, k
    plans = device.session.reductions
    if key in plans:
        return plans[key]

    kernel = kernel_of(device, name)
    if not device.is_cpu:
        items = GPU_GROUP
        values_per_item = GPU_VALUES_PER_ITEM
    else:
        items = CPU_GROUP if k <= CPU_GROUP else CPU_GROUP_OF_MANY_COLUMNS
        values_per_item = CPU_VALUES_PER_ITEM
    group = kernel.group(items)
    groups = 1
    if name != "vector_sums":
        group_limit = max(MIN_GROUP_LIMIT, 4 * device.compute_units)
        filled_groups = -(-rows * k // (group * values_per_item))
        groups = max(1, min(filled_groups, group_limit))
    plans[key] = _Plan(kernel, rows, k, groups, group)
    return plans[key]


def _rows_and_columns(x: Array) -> tuple[int, int]:
    if len(x.shape) == 1:
        return x.shape[0], 1
    rows, columns = x.shape[-2:]
    return rows, columns


def _reduce(name: str, like: Array, /, *, across: int = 1, **arguments: float | Array) -> None:
    """Queue a kernel that sums over the rows of arrays `like` this one, `across` times."""
    kernel, rows, k, groups, group = _plan(name, like)
    items = (groups * group, across, -(-k // group))
    scratch = like.device.local(group)
    kernel(items, (group, 1, 1), rows=rows, k=k, scratch=scratch, **arguments)


def _bind_elementwise(out: Array, name: str, /, **arguments: float | Array) -> Launch:
    """The launch of a kernel with one work-item a value of `out`."""
    kernel = kernel_of(out.device, name)
    return kernel.bind(out.size, 256, count=out.size, out=out, **arguments)


def _same_shape(*arrays: Array) -> None:
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise InputError(f"vectors of different shapes {sorted(shapes)} cannot be combined")
