# SPDX-License-Identifier: BSD-3-Clause
"""Columns of T: decoded with least variance, without noise, in rows that add up to white."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.acquisition.scanning import Hadamard, Pixels, columns
from ltcl.acquisition.scanning.columns import balance, significant
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture
from ltcl.errors import InputError

random = np.random.default_rng(0)
GRID = (24, 20)
M = 480


def is_light(value: np.ndarray) -> np.ndarray:
    """Entries with noise of one standard deviation that count as light."""
    _, keep = significant(value, np.ones_like(value), GRID)
    return keep


@pytest.mark.parametrize("pixels", [1, 2, 3, 5, 16, 63])
@pytest.mark.parametrize("code", [Pixels(), Hadamard()], ids=["pixel", "hadamard"])
def test_columns_are_decoded_exactly_without_noise(code: columns.Code, pixels: int) -> None:
    T = random.random((pixels, 4))
    P = code.patterns(pixels)
    assert len(P) == columns.count_patterns(code, pixels)
    assert P.any(axis=1).all()  # no pattern is black
    x, variance = code.decode(P @ T, np.full((len(P), 4), 1e-4), np.zeros(4))
    np.testing.assert_allclose(x[:pixels], T, atol=1e-12)
    assert variance[:pixels].shape == T.shape


@pytest.mark.parametrize("code", [Pixels(6), Hadamard(7), Hadamard(31)])
def test_it_is_generalised_least_squares(code: columns.Code) -> None:
    """The estimate is (A' K A)^-1 A' K y for y = A x + n - e 1, cov n = diag(v), var e = a."""
    A = code.patterns(code.size).astype(float)
    a = 0.3
    v = random.random(len(A)) + 0.1
    y = random.random(len(A))
    K = np.linalg.inv(np.diag(v) + a)
    C = np.linalg.inv(A.T @ K @ A)
    x, variance = code.decode(y[:, None], v[:, None], np.array([a]))
    np.testing.assert_allclose(x[:, 0], C @ A.T @ K @ y, rtol=1e-9)
    np.testing.assert_allclose(variance[:, 0], np.diag(C), rtol=1e-9)


def test_errors_of_columns_nearly_cancel_in_the_sum_of_an_s_matrix() -> None:
    code = Hadamard(31)
    v = np.full((31, 1), 0.4)
    a = np.array([0.3])
    A = code.patterns(31).astype(float)
    C = np.linalg.inv(A.T @ np.linalg.inv(np.diag(v[:, 0]) + a) @ A)
    np.testing.assert_allclose(code.correlation(v, a), C[0, 1] / C[0, 0], rtol=1e-9)
    # 13 deviations in the sum of all; 2.4 if columns were independent.
    far = np.repeat([[0.015], [0.035]], [24, 7], axis=0)
    far = np.tile(far, M)
    value, keep = significant(far, np.ones((31, M)), GRID, correlation=np.full(M, -1 / 31))
    assert keep.all()
    assert not is_light(far).any()
    np.testing.assert_allclose(value, far)  # eight columns are alike


def test_a_column_that_no_photograph_shows_follows_from_the_sum() -> None:
    pictures = np.array([0.3, 0.0, 0.1, 0.9])
    v = np.array([1e-6, UNKNOWN, 1e-6, 4e-6])
    decoded, variance = Pixels(3).decode(pictures[:, None], v[:, None], np.zeros(1))
    assert decoded[1, 0] == pytest.approx(0.9 - 0.3 - 0.1, rel=1e-6)
    assert variance[1, 0] == pytest.approx(6e-6, rel=1e-6)


@pytest.mark.parametrize("size", [0, 2, 64, 1.5])
def test_other_sizes_are_refused(size: float) -> None:
    with pytest.raises(InputError, match=f"size is {size}"):
        Hadamard(size)  # pyright: ignore[reportArgumentType]


def test_a_weak_block_is_significant_though_no_entry_stands_out() -> None:
    block = np.zeros(GRID, bool)
    block[4:12, 8:16] = True
    noise = 0.3 * random.standard_normal((200, M))
    # Below three standard deviations, all of them.
    value = np.clip(noise + block.ravel(), -2.9, 2.9)
    keep = is_light(value)
    assert keep[:, block.ravel()].mean() > 0.999
    assert np.sum(value[keep]) == pytest.approx(np.sum(value), rel=0.05)


def test_noise_is_dropped_without_a_bias() -> None:
    value = random.standard_normal((400, M))
    keep = np.concatenate([is_light(part) for part in np.split(value, 40)])
    assert keep.mean() < 0.05
    assert abs(np.sum(value[keep])) < 4 * np.sqrt(np.sum(value[keep] ** 2))


def test_weak_light_is_kept() -> None:
    """0.4 standard deviations in all of a column; 0.1 in many columns, but not in a single one."""
    value = random.standard_normal((400, M))
    assert is_light(value + 0.4).mean() > 0.99
    weak = np.full((64, M), 0.1)
    assert not is_light(weak[:1]).any()
    assert is_light(weak).all()


def test_strong_and_unknown_entries_stand_alone() -> None:
    value = np.zeros((1, M))
    variance = np.ones((1, M))
    value[0, 7] = 8.0
    variance[0, 9] = UNKNOWN
    _, keep = significant(value, variance, GRID)
    np.testing.assert_array_equal(np.flatnonzero(keep), [7, 9])
    _, keep = significant(value, variance, GRID, 0.0)
    assert keep.all()


@pytest.mark.parametrize("shape", [(1, 1), (3, 7), (5, 1)])
def test_rows_add_up_by_least_squares(shape: tuple[int, int]) -> None:
    """They solve weighted normal equations for x_j of variance v_j and the sum w of variance u."""
    x = random.random(shape) + 0.1
    v = random.random(shape) + 0.1
    w = x.sum(axis=1) + random.normal(size=shape[0])
    u = random.random(shape[0]) + 0.1
    rows, variance = balance(scipy.sparse.csr_array(x), v.ravel(), Picture(w, u))
    variance = variance.reshape(shape)
    for i, row in enumerate(rows.toarray()):
        C = np.linalg.inv(np.diag(1 / v[i]) + 1 / u[i])
        np.testing.assert_allclose(row, C @ (x[i] / v[i] + w[i] / u[i]), rtol=1e-10)
        np.testing.assert_allclose(variance[i], np.diag(C), rtol=1e-10)


def test_rows_with_something_unknown_stay() -> None:
    x = np.full((3, 2), 0.5)
    v = np.array([0.1, np.nan, 0.1, 0.1, 0.1, 0.1])
    white = Picture(np.full(3, 2.0), np.array([0.1, UNKNOWN, 0.1]))
    rows, variance = balance(scipy.sparse.csr_array(x), v, white)
    np.testing.assert_array_equal(rows.data[:4], 0.5)
    np.testing.assert_array_equal(variance[:4], v[:4])
    assert (rows.data[4:] > 0.5).all()


def test_the_part_of_dropped_entries_goes_to_the_others() -> None:
    """Rows get entries of the median variance there, whose part of the rest is then moved."""
    x = np.array([[1.0, 0.2, 0.0, 0.0]])
    v = np.array([0.3, 0.1])
    white = Picture(np.array([1.5]), np.array([0.05]))
    rows, variance = balance(scipy.sparse.csr_array(x), v, white)
    # The median variance of the row, 0.2, stands for the two dropped entries.
    variances = np.array([0.3, 0.1, 0.2, 0.2])
    total = variances.sum() + 0.05
    [whole] = x + 0.3 * variances / total
    expected = whole[:2] + whole[2:].sum() * v / v.sum()
    np.testing.assert_allclose(rows.data, expected, rtol=1e-12)
    np.testing.assert_allclose(variance, v - v**2 / total, rtol=1e-12)
