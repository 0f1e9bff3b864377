# SPDX-License-Identifier: BSD-3-Clause
"""What a solver does between two products, against NumPy in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.device import Device, vectors
from ltcl.errors import InputError
from tests import gallery, reference
from tests.operators.helpers import close, same_bits

SHAPES = [(1,), (53,), (257,), (53, 7), (1, 5), (1000, 3), (40, 19), (70, 300)]


@pytest.fixture(params=["its own", "a GPU's"])
def shaped(device, request) -> Device:
    """The device, launched as it is and in the shapes of a GPU."""
    if request.param == "its own":
        return device
    other = Device(device.description)
    other.kind = "gpu"
    return other


def operands(device, shape, count=2) -> tuple[Any, ...]:
    k = shape[1] if len(shape) > 1 else None
    hosts = [gallery.vectors(shape[0], k, seed) for seed in range(1, count + 1)]
    return (*hosts, *map(device.upload, hosts))


@pytest.mark.parametrize("shape", SHAPES)
def test_elementwise_kernels_meet_their_twins(shaped, shape):
    x, y, X, Y = operands(shaped, shape)
    out = shaped.empty(shape)
    np.testing.assert_array_equal(
        vectors.fill(out, 0.3).get().ravel(), np.float32(reference.vector_fill(x.size, 0.3))
    )
    error = 2 * reference.gamma(2) * (np.abs(x) + np.abs(y))  # each product and the sum round once
    assert vectors.axpby(0.75, X, -1.5, Y, out) is out
    close(out.get(), reference.vector_axpby(0.75, x, -1.5, y), error)
    close(vectors.axpy(0.75, X, Y.copy()).get(), reference.vector_axpby(0.75, x, 1, y), error)
    d = gallery.vectors(shape[0], None, 3)
    close(vectors.scale_rows(shaped.upload(d), X, out).get(), reference.vector_scale_rows(d, x), error)


@pytest.mark.parametrize("shape", SHAPES)
def test_out_may_be_an_operand(device, shape):
    x, _, X, Y = operands(device, shape)
    wanted, d = vectors.axpby(2.0, X, 3.0, Y, X.like()).get(), device.upload(x.reshape(len(x), -1)[:, 0])
    out = X.copy()
    same_bits(vectors.axpby(2.0, out, 3.0, Y, out).get(), wanted)
    same_bits(vectors.axpby(2.0, X, 3.0, out.copy_from(Y), out).get(), wanted)
    same_bits(vectors.scale_rows(d, out.copy_from(X), out).get(), vectors.scale_rows(d, X, X.like()).get())


@pytest.mark.parametrize("shape", SHAPES)
def test_columns_have_coefficients_of_their_own(device, shape):
    x, y, X, Y = operands(device, shape)
    a, b = np.linspace(-1.5, 2.0, X.columns), np.where(np.arange(X.columns) % 3 == 1, 0.0, 0.75)
    wanted = reference.vector_axpby_columns(a, x, b, y)
    error = 2 * reference.gamma(3) * 2 * (np.abs(x) + np.abs(y))  # the coefficients are rounded, too
    close(vectors.axpby_columns(a, X, b, Y, X.like()).get(), wanted, error)
    close(vectors.axpby_columns(a, X, b, Y, X).get(), wanted, error)
    close(vectors.axpby_columns(2.0, Y, 0.5, Y, Y).get(), 2.5 * y, 4 * error)


@pytest.mark.parametrize("k", [None, 1, 3])
def test_a_coefficient_of_zero_leaves_its_operand_out(device, k):
    _, y, _, Y = operands(device, (53, k) if k else (53,))
    bad = vectors.fill(Y.like(), np.nan)
    same_bits(vectors.axpby_columns(np.zeros(k or 1), bad, 1.0, Y, Y.like()).get(), y.astype(np.float32))
    same_bits(vectors.axpby_columns(1.0, Y, np.zeros(k or 1), bad, bad).get(), y.astype(np.float32))


@pytest.mark.parametrize("rows", [1, 63, 65, 4097, 100_003])
@pytest.mark.parametrize("k", [None, 1, 3, 8, 70, 300])
def test_dot_and_norm_stay_accurate_as_vectors_grow(shaped, rows, k):
    rows = rows if (k or 1) < 70 else rows % 5000 + 1
    x, y, X, Y = operands(shaped, (rows, k) if k else (rows,))
    found = vectors.dot(X, Y)
    assert found.dtype == np.float64
    close(found, reference.vector_dot(x, y), reference.dot_error(x, y))
    np.testing.assert_array_equal(vectors.dot(X, Y), found)  # to the bit, each time
    # Half the relative error of the square, and the square is a sum without cancellation.
    squares = reference.vector_dot(x, x)
    close(vectors.norm(X), np.sqrt(squares), reference.dot_error(x, x) / np.sqrt(squares))
    out = vectors.fill(shaped.empty((3, k or 1)), -1)
    vectors.queue_dot(X, Y, out, 1)
    close(out.get()[1], reference.vector_dot(x, y), reference.dot_error(x, y))
    assert (out.get()[::2] == -1).all()


def test_a_long_sum_of_equal_numbers_does_not_lose_its_tail(device):
    """In sequence, 2^24 + 1 = 2^24 in float32: sums of ones would stop growing there."""
    ones = vectors.fill(device.empty(1 << 20), 5.0)
    assert vectors.dot(ones, ones).tolist() == [25.0 * (1 << 20)]  # partial sums are small integers times 25


@pytest.mark.parametrize("shape", [*SHAPES, (20_001, 3), (5, 2000)])
def test_a_step_moves_all_vectors_and_adds_up_the_squares(shaped, shape):
    p, x, r, d, P, X, R, D = operands(shaped, shape, 4)
    groups, k = vectors.step_groups(X), X.columns
    partials = vectors.fill(shaped.empty((3, groups, k)), np.nan)
    squares = []
    for slot, (keep, gain) in enumerate([(0.5, 0.25), (0.0, 1.5)]):
        vectors.queue_step(P, X, R, D, keep, gain, partials, slot)
        size = np.abs(x) + np.abs(r) + np.abs(p) + np.abs(d)
        x, r, d, square = reference.vector_step(p, x, r, d, keep, gain)
        squares.append(square)
        for found, wanted in ((X, x), (R, r), (D, d)):
            close(found.get(), wanted, reference.gamma(10) * size)
    out = vectors.fill(shaped.empty((4, k)), -1)
    vectors.queue_sum_partials(partials, 2, out)
    close(out.get()[:2], np.array(squares), 2e-6 * np.array(squares))
    assert (out.get()[2:] == -1).all()
    with pytest.raises(InputError, match="partials"):
        vectors.queue_step(P, X, R, D, 1, 1, shaped.empty((3, groups + 1, k)), 0)


@pytest.mark.parametrize(
    ("slots", "groups", "k"), [(1, 1, 1), (3, 64, 8), (8, 53, 7), (2, 5, 1000), (0, 3, 2)]
)
def test_partial_sums_meet_their_twin(shaped, slots, groups, k):
    values = gallery.vectors(slots * groups, k).reshape(slots, groups, k)
    partials, out = shaped.upload(values), shaped.empty((slots, k))
    vectors.queue_sum_partials(partials, slots, out)
    error = reference.gamma(groups) * reference.vector_sums(np.abs(values))
    close(out.get(), reference.vector_sums(values), error)
    with pytest.raises(InputError, match=f"{slots + 1} rows"):
        vectors.queue_sum_partials(partials, slots + 1, out)


def test_nan_and_infinity_come_through(device):
    found = vectors.norm(device.upload([[1.0, 1.0], [np.nan, np.inf]]))
    assert np.isnan(found[0])
    assert np.isinf(found[1])


@pytest.mark.parametrize("shape", [(0,), (0, 3), (4, 0)])
def test_empty_vectors(shaped, shape):
    x = vectors.fill(shaped.empty(shape), 1.0)
    np.testing.assert_array_equal(vectors.dot(x, x), np.zeros(x.columns))


def test_unlike_vectors_are_refused(device):
    x, y = device.empty(3), device.empty((3, 1))
    for act in (
        lambda: vectors.axpby(1, x, 1, y, x),
        lambda: vectors.dot(x, y),
        lambda: vectors.scale_rows(x, x, y),
    ):
        with pytest.raises(InputError, match=r"\(3,\), \(3, 1\)"):
            act()
    with pytest.raises(InputError, match=r"diagonal .*\(4,\).*\(3,\)"):
        vectors.scale_rows(device.empty(4), y, y)


@pytest.mark.parametrize("count", [1, 64, 1000])
def test_triad_meets_its_twin(device, count):
    b, c = (gallery.vectors(8 * count, None, seed) for seed in (1, 2))
    out = device.empty(8 * count)
    device.kernel("vector", "vector_triad")(count, 64, count, 0.5, device.upload(b), device.upload(c), out)
    close(out.get(), reference.vector_triad(0.5, b, c), reference.gamma(2) * (np.abs(b) + np.abs(c)))
