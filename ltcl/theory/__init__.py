# SPDX-License-Identifier: BSD-3-Clause
"""What can be said before solving: spectrum of R, bounds on that of S, products each method will need.

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

__all__ = ["Forecast", "SpectralRadius", "Terms", "TwoNorm"]
__all__ += [
    "after_terms",
    "bounce_coefficients",
    "chebyshev_products",
    "forecasts",
    "forward_error_bound",
]
__all__ += ["free_bounds", "gauss_seidel_forecast", "inverse_error_bound", "richardson_products"]
__all__ += ["row_sum_range", "series_products", "spectral_radius", "two_norm"]
