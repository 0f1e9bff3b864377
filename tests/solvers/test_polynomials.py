# SPDX-License-Identifier: BSD-3-Clause
"""The polynomial of Chebyshev iteration, against its closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import eval_chebyt

from ltcl.errors import InputError
from ltcl.solvers.polynomials import chebyshev_bias, chebyshev_coefficients, chebyshev_degree


@pytest.mark.parametrize("bounds", [(0.5, 1.5), (0.5, 4.0), (0.9, 1.0), (0.3, 10.0)])
@pytest.mark.parametrize("degree", [0, 1, 2, 5, 9])
def test_the_residual_is_the_chebyshev_polynomial(degree, bounds):
    """1 - s p(s - 1) = T_n((c - s) / r) / T_n(c / r), n = degree + 1."""
    centre, half = (bounds[0] + bounds[1]) / 2, (bounds[1] - bounds[0]) / 2
    s = np.linspace(bounds[0], bounds[1], 50)
    p = np.polynomial.polynomial.polyval(s - 1.0, chebyshev_coefficients(degree, bounds))
    wanted = eval_chebyt(degree + 1, (centre - s) / half) / eval_chebyt(degree + 1, centre / half)
    np.testing.assert_allclose(1.0 - s * p, wanted, rtol=0, atol=1e-8)
    assert np.abs(wanted).max() == pytest.approx(chebyshev_bias(degree, bounds))


@pytest.mark.parametrize("rtol", [0.5, 1e-2, 1e-4])
def test_the_degree_is_the_least_that_reaches_the_tolerance(rtol):
    degree = chebyshev_degree(rtol, (0.5, 3.0))
    assert chebyshev_bias(degree, (0.5, 3.0)) <= rtol * (1 + 1e-9)
    assert degree == 0 or chebyshev_bias(degree - 1, (0.5, 3.0)) > rtol


@pytest.mark.parametrize("bounds", [(0.5, 1.5), (0.9, 1.0), (0.001, 2.0)])
def test_coefficients_beyond_float32_are_refused_as_soon_as_they_come(bounds):
    with pytest.raises(
        InputError, match=r"degree is 1000000; .* beyond float32 from degree \d+ on"
    ) as caught:
        chebyshev_coefficients(10**6, bounds)
    first = int(str(caught.value).split("from degree ")[1].split(" ")[0])
    assert np.abs(chebyshev_coefficients(first - 1, bounds)).max() <= np.finfo(np.float32).max
    with pytest.raises(InputError, match=f"from degree {first} on"):
        chebyshev_coefficients(first, bounds)


@pytest.mark.parametrize("upper", [1e30, np.inf])
def test_bounds_that_no_polynomial_fits_are_refused(upper):
    for refused in (chebyshev_degree, lambda rtol, bounds: chebyshev_coefficients(3, bounds)):
        with pytest.raises(InputError, match="too wide for a polynomial"):
            refused(0.1, (0.5, upper))
