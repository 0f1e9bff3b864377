# SPDX-License-Identifier: BSD-3-Clause
"""Choosing a method from what is known of S before the first step, and saying why."""

from __future__ import annotations

import numpy as np

from ltcl import theory
from ltcl.operators import Operator

SMALL = 512  # pixels: below, a dense factorization takes less time than launching kernels
LARGEST_DIRECT = 8192  # pixels: above, a dense factorization is no help in need any more


def choose(S: Operator, rtol: float) -> tuple[str, str]:
    """The method for S x = b to `rtol`, and the reason in words.

    One product tells the row sums of R, and with them a bound on rho(R): far below 1 the plain iteration
    needs no more products than Chebyshev and no bounds; elsewhere Chebyshev with the free bounds needs
    fewest, and converges where the plain iteration does not.
    """
    n = S.shape[0]
    if n <= SMALL:
        return "direct", f"{n} pixels are few enough for a dense factorization"
    if rtol < 1e-6:
        return "direct", f"rtol={rtol:g} is below what float32 products reach"
    rho = float(np.max(np.abs(S.row_sums() - 1.0)))
    plain, chebyshev = (
        theory.series_products(rho, rtol),
        theory.chebyshev_products(*theory.free_bounds(S), rtol),
    )
    if plain <= chebyshev:
        return "jacobi", f"row sums of R are at most {rho:.2g}: {plain} products, Chebyshev {chebyshev}"
    return "chebyshev", f"row sums of R are at most {rho:.2g}: {chebyshev} products"
