# SPDX-License-Identifier: BSD-3-Clause
"""Arrays on the device, and arithmetic between two products against NumPy in float64."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ltcl.device import vectors
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from tests import gallery, reference
from tests.operators.helpers import close, refused, same_bits

SHAPES = [(1,), (53,), (257,), (53, 7), (1, 5), (1000, 3), (40, 19), (70, 300)]


def operands(device, shape, count=2) -> tuple[Any, ...]:
    k = shape[1] if len(shape) > 1 else None
    hosts = [gallery.vectors(shape[0], k, seed) for seed in range(1, count + 1)]
    return (*hosts, *map(device.upload, hosts))


@pytest.mark.parametrize("shape", [(1,), (53,), (53, 7), (0,), (5, 0)])
@pytest.mark.parametrize("dtype", ["float32", "int32"])
def test_values_come_back_as_they_went(device, shape, dtype):
    values = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    array = device.upload(values, dtype)
    assert array.shape == shape
    assert array.dtype == dtype
    assert array.size == values.size
    assert array.nbytes == values.nbytes
    assert array.columns == (1 if len(shape) == 1 else shape[1])
    for same in (array, array.copy(), array.like().copy_from(array), array.like().set(values)):
        assert same.get().dtype == dtype
        np.testing.assert_array_equal(same.get(), values)


def test_strided_arrays_and_other_types_are_converted(device):
    values = gallery.signed(6, 8).astype(np.float64)
    for view in (
        values[::2, ::-1],
        values.T,
        values[:, 3],
        np.array([np.inf, np.nan, 1e-45, 3.4e38]),
    ):
        np.testing.assert_array_equal(device.upload(view).get(), view.astype(np.float32))


@pytest.mark.parametrize("tail", [(), (3,)])
def test_rows_are_copied_out_and_in(device, tail):
    values = np.arange(7 * (3 if tail else 1), dtype=np.float32).reshape(7, *tail)
    x = device.upload(values)
    block = x.rows(2, 3)
    np.testing.assert_array_equal(block.get(), values[2:5])
    x.set_rows(4, block)
    values[4:7] = values[2:5].copy()
    np.testing.assert_array_equal(x.get(), values)
    assert x.rows(7, 0).shape == (0, *tail)


@pytest.mark.parametrize("shape", SHAPES)
def test_elementwise_kernels_meet_their_twins(shaped, shape):
    """The result may overwrite an operand."""
    x, y, X, Y = operands(shaped, shape)
    d = gallery.vectors(shape[0], None, 3)
    out = shaped.empty(shape)
    fill = reference.vector_fill(x.size, 0.3).astype(np.float32)
    np.testing.assert_array_equal(vectors.fill(out, 0.3).get().ravel(), fill)
    # Each product and the sum round once.
    error = 2 * reference.gamma(2) * (np.abs(x) + np.abs(y))
    assert vectors.axpby(0.75, X, -1.5, Y, out) is out
    total = out.get()
    close(total, reference.vector_axpby(0.75, x, -1.5, y), error)
    close(vectors.axpy(0.75, X, Y.copy()).get(), reference.vector_axpby(0.75, x, 1, y), error)
    same_bits(vectors.axpby(0.75, out.copy_from(X), -1.5, Y, out).get(), total)
    same_bits(vectors.axpby(0.75, X, -1.5, out.copy_from(Y), out).get(), total)
    for target in (out, X):
        scaled = vectors.scale_rows(shaped.upload(d), X, target).get()
        close(scaled, reference.vector_scale_rows(d, x), error)


@pytest.mark.parametrize("rows", [1, 63, 65, 4097, 100_003])
@pytest.mark.parametrize("k", [None, 1, 3, 8, 70, 300])
def test_dot_and_norm_stay_accurate_as_vectors_grow(shaped, rows, k):
    rows = rows if (k or 1) < 70 else rows % 5000 + 1
    x, y, X, Y = operands(shaped, (rows, k) if k else (rows,))
    products = vectors.dot(X, Y)
    assert products.dtype == np.float64
    close(products, reference.vector_dot(x, y), reference.dot_error(x, y))
    # The same bits each time.
    np.testing.assert_array_equal(vectors.dot(X, Y), products)
    # Half the relative error of the square, and the square is a sum without cancellation.
    squares = reference.vector_dot(x, x)
    for norm in (vectors.norm(X), vectors.norms(Y, X)[1]):
        close(norm, np.sqrt(squares), reference.dot_error(x, x) / np.sqrt(squares))
    out = vectors.fill(shaped.empty((3, k or 1)), -1)
    vectors.queue_dot(X, Y, out, 1)
    close(out.get()[1], reference.vector_dot(x, y), reference.dot_error(x, y))
    assert (out.get()[::2] == -1).all()


def test_sums_lose_no_tail_and_hide_no_nan(shaped):
    """Sums of ones in sequence would stop growing: 2^24 + 1 = 2^24 in float32."""
    fives = vectors.fill(shaped.empty(1 << 20), 5.0)
    # Partial sums are small integers times 25.
    assert vectors.dot(fives, fives).tolist() == [25.0 * (1 << 20)]
    norms = vectors.norm(shaped.upload([[1.0, 1.0], [np.nan, np.inf]]))
    assert np.isnan(norms[0])
    assert np.isinf(norms[1])
    for shape in ((0,), (0, 3), (4, 0)):
        empty = vectors.fill(shaped.empty(shape), 1.0)
        np.testing.assert_array_equal(vectors.dot(empty, empty), np.zeros(empty.columns))


@pytest.mark.parametrize("shape", [*SHAPES, (20_001, 3), (5, 2000)])
def test_a_step_moves_all_vectors_and_adds_up_the_squares(shaped, shape):
    p, x, r, d, P, X, R, D = operands(shaped, shape, 4)
    groups = vectors.step_groups(X)
    k = X.columns
    partials = vectors.fill(shaped.empty((3, groups, k)), np.nan)
    squares = []
    for slot, (keep, gain) in enumerate([(0.5, 0.25), (0.0, 1.5)]):
        vectors.queue_step(P, X, R, D, keep, gain, partials, slot)
        size = np.abs(x) + np.abs(r) + np.abs(p) + np.abs(d)
        x, r, d, square = reference.vector_step(p, x, r, d, keep, gain)
        squares.append(square)
        for array, exact in ((X, x), (R, r), (D, d)):
            close(array.get(), exact, reference.gamma(10) * size)
    out = vectors.fill(shaped.empty((4, k)), -1)
    vectors.queue_sum_partials(partials, 2, out)
    close(out.get()[:2], np.array(squares), 2e-6 * np.array(squares))
    assert (out.get()[2:] == -1).all()


@pytest.mark.parametrize(
    ("slots", "groups", "k"), [(1, 1, 1), (3, 64, 8), (8, 53, 7), (2, 5, 1000), (0, 3, 2)]
)
def test_partial_sums_meet_their_twin(shaped, slots, groups, k):
    values = gallery.vectors(slots * groups, k).reshape(slots, groups, k)
    partials = shaped.upload(values)
    out = shaped.empty((slots, k))
    vectors.queue_sum_partials(partials, slots, out)
    error = reference.gamma(groups) * reference.vector_sums(np.abs(values))
    close(out.get(), reference.vector_sums(values), error)


def test_refusals(device):
    x = device.empty(3)
    y = device.empty((3, 1))
    z = device.empty((3, 2))
    huge = (1 << 30, 1 << 30)
    refused(
        InputError,
        (r"\(3,\), \(3, 1\)", vectors.axpby, 1, x, 1, y, x),
        (r"\(3,\), \(3, 1\)", vectors.dot, x, y),
        (r"diagonal .*\(4,\).*\(3,\)", vectors.scale_rows, device.empty(4), y, y),
        (r"\(6,\).*\(3, 2\)", z.set, np.zeros(6)),
        ("2 to 4 .*3", z.rows, 2, 2),
        ("rows 2", z.set_rows, 2, z),
        ("float32", device.upload, [1e39]),
        ("float32", device.empty(1).set, np.array([-1e300])),
    )
    refused(
        MemoryLimitError,
        ("TiB", device.upload, np.broadcast_to(np.int8(0), huge)),
        ("TiB", dataclasses.replace(device.empty(1), shape=huge).get),
    )
    refused(
        InputTypeError, ("1 masked", device.upload, np.ma.masked_array([1.0, 2.0], [False, True]))
    )
