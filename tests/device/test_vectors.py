# SPDX-License-Identifier: BSD-3-Clause
"""What a solver does between two products, against NumPy in float64."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import Array, vectors
from ltcl.errors import InputError
from tests import gallery, reference
from tests.operators.helpers import close, same_bits

SHAPES = [(1,), (53,), (64,), (257,), (53, 7), (1, 5), (1000, 3)]
SIZES = [1, 63, 64, 65, 4096, 4097, 100_003]


def operands(device, shape):
    k = shape[1] if len(shape) > 1 else None
    x, y = gallery.vectors(shape[0], k), gallery.vectors(shape[0], k, 2)
    return x, y, device.upload(x), device.upload(y)


@pytest.mark.parametrize("shape", SHAPES)
def test_elementwise_kernels_meet_their_twins(device, shape):
    x, y, X, Y = operands(device, shape)
    out = device.empty(shape)
    np.testing.assert_array_equal(
        vectors.fill(out, 0.3).get().ravel(), np.float32(reference.vector_fill(x.size, 0.3))
    )
    # Each product and the sum round once.
    error = 2 * reference.gamma(2) * (np.abs(x) + np.abs(y))
    a, b = 0.75, -1.5
    assert vectors.axpby(a, X, b, Y, out) is out
    close(out.get(), reference.vector_axpby(a, x, b, y), error)
    close(vectors.difference(X, Y, out).get(), reference.vector_axpby(1, x, -1, y), error)
    close(vectors.axpy(a, X, Y.copy()).get(), reference.vector_axpby(a, x, 1, y), error)
    d = gallery.vectors(shape[0], None, 3)
    close(vectors.scale_rows(device.upload(d), X, out).get(), reference.vector_scale_rows(d, x), error)
    close(vectors.multiply(X, Y, out).get(), np.float64(x) * y, reference.gamma(1) * np.abs(x * y))


@pytest.mark.parametrize("shape", SHAPES)
def test_columns_have_coefficients_of_their_own(device, shape):
    x, y, X, Y = operands(device, shape)
    k = X.columns
    a, b = np.linspace(-1.5, 2.0, k), np.where(np.arange(k) % 3 == 1, 0.0, 0.75)
    wanted = reference.vector_axpby_columns(a, x, b, y)
    error = 2 * reference.gamma(3) * 2 * (np.abs(x) + np.abs(y))  # the coefficients are rounded, too
    out = device.empty(shape)
    assert vectors.axpby_columns(a, X, b, Y, out) is out
    close(out.get(), wanted, error)
    same_bits(vectors.axpby_columns(a, X, b, Y, X.copy()).get(), out.get())
    close(vectors.axpby_columns(a, X, b, Y, X).get(), wanted, error)
    close(vectors.axpby_columns(2.0, Y, 0.5, Y, Y).get(), 2.5 * y, 4 * error)


@pytest.mark.parametrize("k", [None, 1, 3])
def test_a_coefficient_of_zero_leaves_its_operand_out(device, k):
    x, y, _, Y = operands(device, (53, k) if k else (53,))
    bad = device.upload(np.where(x > 0, np.nan, np.inf))
    same_bits(vectors.axpby_columns(np.zeros(k or 1), bad, 1.0, Y, Y.like()).get(), y.astype(np.float32))
    same_bits(vectors.axpby_columns(1.0, Y, np.zeros(k or 1), bad, bad).get(), y.astype(np.float32))


def test_a_coefficient_beyond_float32_is_infinite(device):
    for k in (1, 2):
        x = vectors.fill(device.empty((3, k)), 1.0)
        assert np.isposinf(vectors.axpby_columns(1e300, x, 1.0, x, x).get()).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_out_may_be_an_operand(device, shape):
    x, _, X, Y = operands(device, shape)
    d = gallery.vectors(shape[0], None, 3)
    fresh = vectors.axpby(2.0, X, 3.0, Y, X.like()).get()
    for out in (X.copy(), Y.copy()):
        first, second = (out, Y) if np.array_equal(out.get(), x) else (X, out)
        same_bits(vectors.axpby(2.0, first, 3.0, second, out).get(), fresh)
    scaled = vectors.scale_rows(device.upload(d), X, X.like()).get()
    same_bits(vectors.scale_rows(device.upload(d), X, X).get(), scaled)


@pytest.mark.parametrize("rows", SIZES)
@pytest.mark.parametrize("k", [None, 1, 3, 8])
def test_dot_and_norm_stay_accurate_as_vectors_grow(device, rows, k):
    x, y = gallery.vectors(rows, k), gallery.vectors(rows, k, 2)
    X, Y = device.upload(x), device.upload(y)
    found = vectors.dot(X, Y)
    assert found.dtype == np.float64
    close(found, reference.vector_dot(x, y), reference.dot_error(x, y))
    squares = reference.vector_dot(x, x)
    # Half the relative error of the square, and the square is a sum without cancellation.
    close(vectors.norm(X), np.sqrt(squares), reference.dot_error(x, x) / np.sqrt(squares))


def test_dot_repeats_to_the_bit(device):
    _, _, X, Y = operands(device, (100_003, 2))
    first = vectors.dot(X, Y)
    for _ in range(5):
        np.testing.assert_array_equal(vectors.dot(X, Y), first)


def test_a_long_sum_of_equal_numbers_does_not_lose_its_tail(device):
    """In sequence, 2^24 + 1 = 2^24 in float32: sums of ones would stop growing there."""
    n = 1 << 20
    ones = vectors.fill(device.empty(n), 5.0)
    assert vectors.dot(ones, ones).tolist() == [
        25.0 * n
    ]  # exact: all partial sums are small integers times 25


@pytest.mark.parametrize("shape", SHAPES)
def test_many_dots_wait_once(device, shape, monkeypatch):
    x, y, X, Y = operands(device, shape)
    reads = []
    read = Array.get
    monkeypatch.setattr(Array, "get", lambda self: reads.append(self) or read(self))
    found = vectors.dots([X, Y, X], Y)
    assert len(reads) == 1
    assert found.shape == (3, X.columns)
    for one, other in zip(found, (x, y, x), strict=True):
        close(one, reference.vector_dot(other, y), reference.dot_error(other, y))


@pytest.mark.parametrize("shape", [*SHAPES, (5000, 3)])
@pytest.mark.parametrize("last", [0.7, np.nan, np.inf])
def test_the_best_iterate_is_kept_without_the_host(device, shape, last):
    """Rows are residuals of iterates in turn; NaN and infinity are never the best, nor what follows them."""
    x, y, X, Y = operands(device, shape)
    k = X.columns
    weights = gallery.vectors(k, None, 4) ** 2 + 0.1
    rows = np.array([4.0, 2.0, 2.0, 3.0, 1.0, last, 0.5])[:, None] * np.ones(k)
    rows[5, 1:] = 1.0  # one column is enough
    squares = device.upload(rows)
    for slot in range(len(rows)):
        for lowest in (np.inf, 3.0 * np.max(weights), 0.0):
            best = vectors.keep(device.upload(weights), squares, slot, lowest, X, Y.copy())
            kept = reference.vector_keep(weights, rows, slot, lowest, x, y)
            same_bits(best.get(), np.asarray(kept, np.float32))


def test_nan_and_infinity_come_through(device):
    x = device.upload([[1.0, 1.0], [np.nan, np.inf]])
    found = vectors.norm(x)
    assert np.isnan(found[0])
    assert np.isinf(found[1])


@pytest.mark.parametrize("shape", [(0,), (0, 3), (4, 0)])
def test_empty_vectors(device, shape):
    x = device.empty(shape)
    vectors.fill(x, 1.0)
    np.testing.assert_array_equal(vectors.dot(x, x), np.zeros(x.columns))


def test_unlike_vectors_are_refused(device):
    x, y = device.empty(3), device.empty((3, 1))
    for act in (
        lambda: vectors.axpby(1, x, 1, y, x),
        lambda: vectors.dot(x, y),
        lambda: vectors.scale_rows(x, x, y),
    ):
        with pytest.raises(InputError, match=r"vectors of different shapes \[\(3,\), \(3, 1\)\]"):
            act()
    with pytest.raises(InputError, match=r"the diagonal has shape \(4,\); it must be \(3,\)"):
        vectors.scale_rows(device.empty(4), y, y)


@pytest.mark.parametrize("count", [1, 64, 1000])
def test_triad_meets_its_twin(device, count):
    b, c = gallery.vectors(8 * count, None), gallery.vectors(8 * count, None, 2)
    out = device.empty(8 * count)
    device.kernel("vector", "vector_triad")(count, 64, count, 0.5, device.upload(b), device.upload(c), out)
    close(out.get(), reference.vector_triad(0.5, b, c), reference.gamma(2) * (np.abs(b) + np.abs(c)))
