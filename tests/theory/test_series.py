# SPDX-License-Identifier: BSD-3-Clause
"""The cancellation of bounces by expanding both sides, and the bounds by measured errors."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ltcl import theory
from tests.problems import enclosure


def inverse_series(R: np.ndarray, n: int) -> np.ndarray:
    """I - R + ... + (-1)^n R^n (eq. 10)."""
    return sum((np.linalg.matrix_power(-R, k) for k in range(n + 1)), np.zeros_like(R))


@given(st.integers(0, 60), st.integers(0, 90))
def test_bounces_2_to_n_cancel_and_the_rest_has_a_closed_form(n, bounces):
    coefficients = theory.bounce_coefficients(n, bounces)
    assert len(coefficients) == bounces + 1
    for j, coefficient in enumerate(coefficients):
        assert type(coefficient) is int
        assert coefficient == closed_form(n, j)


def closed_form(n: int, j: int) -> int:
    """The coefficient of A^j: 1, -1, 0 up to n, then a cut alternating sum of Pascal's triangle."""
    if j == 0:
        return 1
    if n == 0:
        return 0
    if j == 1:
        return -1
    if j <= n:
        return 0
    return (-1) ** n * comb(j - 2, n - 1)


@pytest.mark.parametrize("m", [0.1, 0.3, 0.45, 0.49])
def test_errors_in_a_closed_box_stay_below_the_bounds_with_the_same_slope(m):
    """||A|| = m in the 2-norm and in the largest row sum: the forward bound is met exactly."""
    box = enclosure(30, m)
    exact = np.eye(30) - box.A
    inverse = []
    forward = []
    for n in range(8):
        partial = inverse_series(-box.A, n)
        for norm in (2, np.inf):
            forward.append(np.linalg.norm(box.S - partial, norm) / theory.forward_error_bound(m, n))
            inverse.append(
                np.linalg.norm(exact - inverse_series(box.R, n), norm)
                / theory.inverse_error_bound(m, n)
            )
    np.testing.assert_allclose(forward, 1.0, rtol=1e-6)
    assert max(inverse) <= 1.0
    # 1 / (1 + q) beside 1 / (1 - q), q = m / (1 - m): a constant, hence the same slope.
    np.testing.assert_allclose(inverse[::2], 1.0 - 2.0 * m, rtol=1e-5)


@pytest.mark.parametrize("m", [0.2, 0.45, 0.6])
def test_errors_after_terms_are_the_bounds(m):
    for terms in theory.after_terms(m, (1, 3, 6)):
        assert terms.forward == pytest.approx(theory.forward_error_bound(m, terms.n))
        inverse = theory.inverse_error_bound(m, terms.n) if m < 0.5 else np.nan
        assert terms.inverse == pytest.approx(inverse, nan_ok=True)
        assert terms.next_bounce == (-1) ** terms.n
