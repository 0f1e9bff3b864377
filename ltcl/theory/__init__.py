# SPDX-License-Identifier: BSD-3-Clause
"""Facts that hold before a solve: spectrum of R, bounds on that of S, products of each method.

Notation of the paper: A one bounce, R = A + A^2 + ..., S = I + R; m bounds the albedo.
"""

from __future__ import annotations

from ltcl.theory.forecast import (
    Forecast,
    chebyshev_products,
    forecasts,
    gauss_seidel_forecast,
    richardson_products,
    series_products,
)
from ltcl.theory.norms import TwoNorm, two_norm
from ltcl.theory.series import (
    Terms,
    after_terms,
    bounce_coefficients,
    forward_error_bound,
    inverse_error_bound,
)
from ltcl.theory.spectrum import SpectralRadius, free_bounds, row_sum_range, spectral_radius

__all__ = [
    "Forecast",
    "SpectralRadius",
    "Terms",
    "TwoNorm",
    "after_terms",
    "bounce_coefficients",
    "chebyshev_products",
    "forecasts",
    "forward_error_bound",
    "free_bounds",
    "gauss_seidel_forecast",
    "inverse_error_bound",
    "richardson_products",
    "row_sum_range",
    "series_products",
    "spectral_radius",
    "two_norm",
]
