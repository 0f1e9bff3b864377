# SPDX-License-Identifier: BSD-3-Clause
"""What a solver does between two products: fill, axpby, axpby column by column, scaling, dot, norm.

Everything is queued and returns at once; only `dot`, `dots` and `norm` give numbers to the host and so wait.
Sums are trees over a fixed number of slices: the same bits at every call on a given device.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ltcl.device.array import Array
from ltcl.errors import InputError

_AT_ONCE = {True: 128, False: 16}  # values an item of a CPU or not sums: up to so many, one launch will do
_SLICES = 64  # partial sums of a dot product: enough groups for a large GPU, few enough for one last group
_COPIERS = {True: 1 << 12, False: 1 << 16}  # items of `keep` on a CPU or not: each has a rule to work out


def fill(x: Array, value: float) -> Array:
    """x = value everywhere."""
    _elementwise(x, "vector_fill", float(value), x)
    return x


def axpby(a: float, x: Array, b: float, y: Array, out: Array) -> Array:
    """out = a x + b y; `out` may be `x` or `y`."""
    _same_shape(x, y, out)
    _elementwise(out, "vector_axpby", float(a), x, float(b), y, out)
    return out


def axpy(a: float, x: Array, y: Array) -> Array:
    """y = a x + y."""
    return axpby(a, x, 1.0, y, y)


def axpby_columns(a: ArrayLike, x: Array, b: ArrayLike, y: Array, out: Array) -> Array:
    """out = a_c x_c + b_c y_c in every column c; `out` may be `x` or `y`.

    `a` and `b` are numbers or (k,) on the host. An operand whose coefficient is 0 does not count, not even
    its NaN: with (0, 1) a column of y stays as it is, whatever became of x.
    """
    _same_shape(x, y, out)
    k = out.columns
    with np.errstate(over="ignore"):  # a step beyond float32 becomes infinite, which the residual tells
        parts = [np.asarray(c).astype(np.float32) for c in (a, b)]
    if k == 1 and all(parts):  # numbers travel with the launch, arrays before it
        return axpby(parts[0].item(), x, parts[1].item(), y, out)
    ab = np.stack([np.broadcast_to(part, k) for part in parts])
    _elementwise(out, "vector_axpby_columns", k, out.device.upload(ab), x, y, out)
    return out


def difference(x: Array, y: Array, out: Array) -> Array:
    """out = x - y."""
    return axpby(1.0, x, -1.0, y, out)


def scale_rows(d: Array, x: Array, out: Array) -> Array:
    """out = diag(d) x with d (N,) and x (N,) or (N, k); `out` may be `x`."""
    _same_shape(x, out)
    if d.shape != x.shape[:1]:
        raise InputError(f"the diagonal has shape {d.shape}; it must be {x.shape[:1]}")
    _elementwise(out, "vector_scale_rows", x.columns, d, x, out)
    return out


def multiply(x: Array, y: Array, out: Array) -> Array:
    """out = x y, entry by entry; `out` may be `x` or `y`."""
    _same_shape(x, y, out)
    _elementwise(out, "vector_scale_rows", 1, x, y, out)  # of one column as long as all
    return out


def dot(x: Array, y: Array) -> np.ndarray:
    """<x_c, y_c> of every column c, as (k,) float64; waits for the device."""
    return dots([x], y)[0]


def dots(xs: Sequence[Array], y: Array) -> np.ndarray:
    """<x_c, y_c> of every column c for each x of `xs`, as (len(xs), k) float64; waits once for all."""
    out = y.device.empty((len(xs), y.columns))
    for slot, x in enumerate(xs):
        queue_dot(x, y, out, slot)
    return out.get().astype(np.float64)


def queue_dot(x: Array, y: Array, out: Array, slot: int) -> None:
    """Row `slot` of `out` (slots, k) = <x_c, y_c> of every column c; does not wait."""
    _same_shape(x, y)
    device, k = x.device, x.columns
    rows = x.shape[0]
    kernel = device.kernel("vector", "vector_dot")
    group = 64 if device.is_cpu else 256
    group = min(group, kernel.largest_group())
    scratch = device.local(group)
    if rows <= _AT_ONCE[device.is_cpu] * group:
        kernel((group, k), (group, 1), rows, k, 0, x, y, out, slot * k, scratch)
        return
    slices = min(_SLICES, -(-rows // group))
    sums = device.empty((slices, k))
    kernel((slices * group, k), (group, 1), rows, k, 0, x, y, sums, 0, scratch)
    kernel((group, k), (group, 1), slices, k, 1, sums, sums, out, slot * k, scratch)


def keep(weights: Array, squares: Array, slot: int, lowest: float, x: Array, best: Array) -> Array:
    """best = x, where ``max(weights * squares[slot])`` is at most `lowest` and that of every row before.

    `weights` are (k,), `squares` (slots, k), for the columns of `x`; nothing is read back. What comes after a
    row that is not finite is no best.
    """
    _same_shape(x, best)
    items = min(_COPIERS[x.device.is_cpu], x.size)
    kernel = x.device.kernel("vector", "vector_keep")
    group = min(64, kernel.largest_group())
    with np.errstate(over="ignore"):
        lowest = float(np.float32(lowest))
    kernel(items, group, x.size, x.columns, slot, lowest, weights, squares, x, best)
    return best


def norm(x: Array) -> np.ndarray:
    """Euclidean norm of every column, as (k,) float64; waits for the device."""
    return np.sqrt(dot(x, x))


def _elementwise(out: Array, name: str, *arguments: float | Array) -> None:
    kernel = out.device.kernel("vector", name)
    kernel(out.size, min(256, kernel.largest_group()), out.size, *arguments)


def _same_shape(*arrays: Array) -> None:
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        raise InputError(f"vectors of different shapes {sorted(shapes)} cannot be combined")
