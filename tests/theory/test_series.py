# SPDX-License-Identifier: BSD-3-Clause
"""The cancellation of bounces by expanding both sides, and the bounds by measured errors."""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ltcl import theory
from ltcl.errors import InputError
from tests.problems import enclosure


def inverse_series(R: np.ndarray, n: int) -> np.ndarray:
    """I - R + ... + (-1)^n R^n (eq. 10)."""
    return sum((np.linalg.matrix_power(-R, k) for k in range(n + 1)), np.zeros_like(R))


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


BAD: dict[str, tuple[Callable[..., Any], tuple[Any, ...], str]] = {
    "m at least 1/2": (theory.inverse_error_bound, (0.62, 3), r"m is 0\.62.*1/2"),
    "orders below 1": (theory.after_terms, (0.3, [0]), "orders is 0"),
    "m of 1": (theory.norm_bound, (1.0,), "m is 1"),
    "m below 0": (theory.forward_error_bound, (-0.1, 2), r"m is -0\.1"),
    "m unknown": (theory.inverse_error_bound, (float("nan"), 2), "m is nan"),
    "m no number": (theory.norm_bound, ("x",), "m is 'x'"),
    "n below 0": (theory.bounce_coefficients, (-1, 2), "n is -1"),
    "n broken": (theory.bounce_coefficients, (1.5, 2), r"n is 1\.5"),
    "bounces true": (theory.bounce_coefficients, (2, True), "bounces is True"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_out_of_range_is_refused(case):
    bound, arguments, says = BAD[case]
    with pytest.raises(InputError, match=says):
        bound(*arguments)


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
