# SPDX-License-Identifier: BSD-3-Clause
"""Forecasts against closed forms."""

from __future__ import annotations

import math

import pytest
from numpy.polynomial.chebyshev import Chebyshev

from ltcl import theory


@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize("rho", [0.0, 1e-3, 0.3, 0.77, 0.99, 1.0, 4.0])
def test_the_series_takes_the_first_power_below_the_tolerance(rho, rtol):
    if rho >= 1.0:
        assert theory.series_products(rho, rtol) == math.inf
        return
    k = theory.series_products(rho, rtol)
    assert k >= 1
    assert rho**k <= rtol * (1 + 1e-12)
    assert k == 1 or rho ** (k - 1) > rtol * (1 - 1e-12)


@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5])
@pytest.mark.parametrize(("lower", "upper"), [(0.5, 1.5), (0.5, 2.0), (0.5, 5.0), (0.5, 50.0), (0.2, 1.8)])
def test_chebyshev_takes_the_first_degree_below_the_tolerance(lower, upper, rtol):
    """The best polynomial of degree k with p(0) = 1 has maximum 1 / T_k(centre / radius) on the interval."""
    k = theory.chebyshev_products(lower, upper, rtol)
    centre = (upper + lower) / (upper - lower)
    assert 1 / Chebyshev.basis(k)(centre) <= rtol * (1 + 1e-9)
    assert k == 1 or 1 / Chebyshev.basis(k - 1)(centre) > rtol * (1 - 1e-9)


def test_a_spectrum_of_one_point_takes_one_product():
    assert theory.chebyshev_products(2.0, 2.0, 1e-9) == 1
