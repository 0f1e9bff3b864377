# SPDX-License-Identifier: BSD-3-Clause
"""The cancellation of bounces by expanding both sides, and the bounds by measured errors."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial

from ltcl import theory
from ltcl.errors import InputError
from tests.problems import enclosure, lambertian


def inverse_series(R: np.ndarray, n: int) -> np.ndarray:
    """I - R + ... + (-1)^n R^n (eq. 10)."""
    return sum((np.linalg.matrix_power(-R, k) for k in range(n + 1)), np.zeros_like(R))


@pytest.mark.parametrize("n", range(6))
def test_the_coefficients_are_those_of_the_expanded_series(n):
    """With R = x + x^2 + ... cut after x^8, whose powers are exact up to x^8."""
    R = Polynomial([0, *([1] * 8)])
    expanded = sum(((-1) ** k * R**k for k in range(n + 1)), Polynomial([0])).coef
    wanted = np.zeros(9)
    wanted[: min(9, len(expanded))] = expanded[:9]
    assert theory.bounce_coefficients(n, 8) == tuple(wanted)


@pytest.mark.parametrize("n", range(5))
@pytest.mark.parametrize("rho", [0.05, 0.3])
def test_both_sides_of_eq_12_agree_on_a_small_scene(n, rho):
    scene = lambertian(12, rho, seed=3)
    powers = 40  # m^40 binom(39, n) is below rounding at rho(A) = 0.23
    terms = theory.bounce_coefficients(n, powers)
    right = sum(c * np.linalg.matrix_power(scene.A, j) for j, c in enumerate(terms))
    np.testing.assert_allclose(inverse_series(scene.R, n), right, rtol=0, atol=1e-12)


@given(st.integers(0, 60), st.integers(0, 90))
def test_bounces_2_to_n_cancel_and_the_rest_has_a_closed_form(n, bounces):
    """The alternating sum of a row of Pascal's triangle, cut short: (-1)^n binom(j-2, n-1)."""
    found = theory.bounce_coefficients(n, bounces)
    assert all(type(c) is int for c in found)
    assert len(found) == bounces + 1
    assert found[:2] == (1, -1 if n else 0)[: bounces + 1]
    assert not any(found[2 : n + 1])
    beyond = range(max(2, n + 1), bounces + 1)
    assert [found[j] for j in beyond] == [(-1) ** n * comb(j - 2, n - 1) if n else 0 for j in beyond]


@pytest.mark.parametrize("m", [0.1, 0.3, 0.45, 0.49])
def test_errors_in_a_closed_box_stay_below_the_bounds_with_the_same_slope(m):
    """There ||A|| = m in the 2-norm and in the largest row sum, so that the forward bound is met exactly."""
    box = enclosure(30, m)
    exact = np.eye(30) - box.A
    inverse, forward = [], []
    for n in range(8):
        partial = sum((np.linalg.matrix_power(box.A, k) for k in range(n + 1)), np.zeros_like(box.A))
        for norm in (2, np.inf):
            forward.append(np.linalg.norm(box.S - partial, norm) / theory.forward_error_bound(m, n))
            inverse.append(
                np.linalg.norm(exact - inverse_series(box.R, n), norm) / theory.inverse_error_bound(m, n)
            )
    np.testing.assert_allclose(forward, 1.0, rtol=1e-6)
    assert max(inverse) <= 1.0
    # 1 / (1 + q) beside 1 / (1 - q), q = m / (1 - m): a constant, hence the same slope.
    np.testing.assert_allclose(inverse[::2], 1.0 - 2.0 * m, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_errors_in_open_scenes_stay_below_the_bounds(seed):
    scene = lambertian(20, 0.5, seed, density=0.4)
    m = float(np.linalg.norm(scene.A, np.inf))
    assert np.linalg.norm(scene.R, np.inf) <= theory.norm_bound(m) * (1 + 1e-12)
    if m < 0.5:
        for n in range(6):
            left = np.linalg.norm(np.eye(20) - scene.A - inverse_series(scene.R, n), np.inf)
            assert left <= theory.inverse_error_bound(m, n)


@pytest.mark.parametrize("m", [0.5, 0.62, 0.99])
def test_the_inverse_bound_names_its_domain(m):
    with pytest.raises(InputError, match=rf"m is {m}; .*eq. 16.* needs an albedo m below 1/2"):
        theory.inverse_error_bound(m, 3)
    assert theory.forward_error_bound(m, 3) > 0


@pytest.mark.parametrize("m", [-0.1, 1.0, 1.5, float("nan"), "x"])
@pytest.mark.parametrize(
    "bound",
    [
        theory.norm_bound,
        lambda m: theory.forward_error_bound(m, 2),
        lambda m: theory.inverse_error_bound(m, 2),
    ],
)
def test_an_albedo_outside_its_range_is_refused(bound, m):
    with pytest.raises(InputError, match=r"m is .*; it must be a finite number at least 0 and below 1"):
        bound(m)


@pytest.mark.parametrize(("n", "bounces"), [(-1, 2), (2, -1), (1.5, 2), (2, True)])
def test_counts_are_whole_numbers(n, bounces):
    with pytest.raises(InputError, match="must be a whole number of at least 0"):
        theory.bounce_coefficients(n, bounces)


@pytest.mark.parametrize("m", [0.2, 0.45, 0.6])
def test_what_terms_leave_is_never_less_than_measured(m):
    """||S - S_n|| and ||S^-1 - S_n^-1|| of an enclosure, whose A has the norm m in the weighted 2-norm."""
    scene = enclosure(12, m)
    A, weight = scene.A, np.sqrt(scene.weights)

    def norm(M: np.ndarray) -> float:
        return float(np.linalg.norm(weight[:, None] * M / weight, 2))

    S, identity = np.linalg.inv(np.eye(12) - A), np.eye(12)
    for terms in theory.after_terms(norm(A), (1, 3, 6)):
        forward = sum((np.linalg.matrix_power(A, k) for k in range(terms.n + 1)), np.zeros_like(A))
        assert norm(S - forward) <= terms.forward * (1 + 1e-9)
        error = norm(np.linalg.inv(S) - inverse_series(S - identity, terms.n))
        assert np.isnan(terms.inverse) == (norm(A) >= 0.5)
        assert np.isnan(terms.inverse) or error <= terms.inverse * (1 + 1e-9)
        assert terms.next_bounce == (-1) ** terms.n


def test_orders_below_one_are_refused():
    with pytest.raises(InputError, match="orders is 0"):
        theory.after_terms(0.3, [0])
