# SPDX-License-Identifier: BSD-3-Clause
"""What a solver does between two products: fill, axpby, axpby column by column, scaling, dot, norm.

Everything is queued and returns at once; only `dot` and `norm` give numbers to the host and so wait.
Sums are trees over a fixed number of slices: the same bits at every call on a given device.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ltcl.device.array import Array
from ltcl.device.kernels import Kernel
from ltcl.errors import InputError

_VALUES = {True: 128, False: 8}  # of an item of a CPU or not, before a reduction takes another group


def fill(x: Array, value: float) -> Array:
    """x = value everywhere."""
    return _elementwise(x, "vector_fill", float(value))


def axpby(a: float, x: Array, b: float, y: Array, out: Array) -> Array:
    """out = a x + b y; `out` may be `x` or `y`."""
    _same_shape(x, y, out)
    return _elementwise(out, "vector_axpby", float(a), x, float(b), y)


def axpy(a: float, x: Array, y: Array) -> Array:
    """y = a x + y."""
    return axpby(a, x, 1.0, y, y)


def axpby_columns(a: ArrayLike, x: Array, b: ArrayLike, y: Array, out: Array) -> Array:
    """out = a_c x_c + b_c y_c in every column c; `out` may be `x` or `y`. Waits for the device.

    `a` and `b` are numbers or (k,) on the host. An operand whose coefficient is 0 does not count, not even
    its NaN: with (0, 1) a column of y stays as it is, whatever became of x.
    """
    _same_shape(x, y, out)
    ab = out.device.upload([np.broadcast_to(c, out.columns) for c in (a, b)])
    return _elementwise(out, "vector_axpby_columns", out.columns, ab, x, y)


def scale_rows(d: Array, x: Array, out: Array) -> Array:
    """out = diag(d) x with d (N,) and x (N,) or (N, k); `out` may be `x`."""
    _same_shape(x, out)
    if d.shape != x.shape[:1]:
        raise InputError(f"the diagonal has shape {d.shape}; it must be {x.shape[:1]}")
    return _elementwise(out, "vector_scale_rows", x.columns, d, x)


def dot(x: Array, y: Array) -> np.ndarray:
    """<x_c, y_c> of every column c, as (k,) float64; waits for the device."""
    _same_shape(x, y)
    reduction = _reduction("vector_dot", x)
    sums = x.device.empty((reduction.groups, x.columns))
    reduction.queue(x, y, sums, 0)
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
    reduction = _reduction("vector_dot", x)
    if reduction.groups == 1:
        reduction.queue(x, y, out, slot * x.columns)
        return
    sums = x.device.empty((1, reduction.groups, x.columns))
    reduction.queue(x, y, sums, 0)
    _queue_sums(sums, 1, out, slot)


def queue_step(
    p: Array, x: Array, r: Array, d: Array, keep: float, gain: float, partials: Array, slot: int
) -> None:
    """x += d, r -= p, d = keep d + gain r, in one launch, where p = S d; does not wait.

    The squares of the new r are added up column by column into row `slot` of `partials`, which is
    (slots, step_groups(x), k).
    """
    _same_shape(p, x, r, d)
    reduction = _reduction("vector_step", x)
    row = (reduction.groups, x.columns)
    if partials.shape[1:] != row:
        raise InputError(f"partials are {partials.shape}; they must be (slots, {row[0]}, {row[1]})")
    reduction.queue(keep, gain, slot * row[0] * row[1], p, x, r, d, partials)


def step_groups(x: Array) -> int:
    """Into how many partial sums a column `queue_step` adds up the squares of a vector like `x`."""
    return _reduction("vector_step", x).groups


def queue_sum_partials(partials: Array, slots: int, out: Array) -> None:
    """First `slots` rows of `out` (slots, k) = those of `partials` (slots, groups, k), added up."""
    if partials.shape[2:] != out.shape[1:] or not slots <= min(partials.shape[0], out.shape[0]):
        raise InputError(f"{slots} rows of partials {partials.shape} cannot be added up into {out.shape}")
    _queue_sums(partials, slots, out, 0)


def _queue_sums(partials: Array, slots: int, out: Array, slot: int) -> None:
    kernel = _reduction("vector_sums", out, rows=partials.shape[1])
    kernel.queue(partials, out, slot * out.columns, across=slots)


class _Reduction:
    """A kernel that sums over the rows of (rows, k) in `groups` work-groups, and how it is launched."""

    def __init__(self, x: Array, name: str, rows: int, k: int) -> None:
        device, self._sizes = x.device, (rows, k)
        self._kernel = _kernel(x, name)
        group = self._kernel.group((16 if k <= 16 else 64) if device.is_cpu else 256)
        most = max(64, 4 * device.compute_units)  # enough for a large GPU, few enough for one last group
        wanted = 1 if name == "vector_sums" else -(-rows * k // (group * _VALUES[device.is_cpu]))
        self.groups = max(1, min(wanted, most))
        self._group, self._items, self._parts = (group, 1, 1), self.groups * group, -(-k // group)
        self._local = device.local(group)

    def queue(self, *arguments: float | Array, across: int = 1) -> None:
        """Launch it with `arguments` between the sizes and the local memory."""
        self._kernel((self._items, across, self._parts), self._group, *self._sizes, *arguments, self._local)


def _reduction(name: str, x: Array, rows: int | None = None) -> _Reduction:
    """That of vectors like `x`, made once, or of as many columns and `rows` rows."""
    key = (name, x.shape[0] if rows is None else rows, x.columns)
    if key not in x.device.reductions:
        x.device.reductions[key] = _Reduction(x, *key)
    return x.device.reductions[key]


def _kernel(x: Array, name: str) -> Kernel:
    return x.device.kernel("vector", name, **({} if x.device.is_cpu else {"ADJACENT": 0}))


def _elementwise(out: Array, name: str, *arguments: float | Array) -> Array:
    _kernel(out, name)(out.size, 256, out.size, *arguments, out)
    return out


def _same_shape(*arrays: Array) -> None:
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise InputError(f"vectors of different shapes {sorted(shapes)} cannot be combined")
