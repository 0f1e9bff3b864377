# SPDX-License-Identifier: BSD-3-Clause
"""Choosing a method from what is known of S before the first step, and saying why."""

from __future__ import annotations

import numpy as np

from ltcl import theory
from ltcl.operators import Operator

SMALL = 512  # pixels: below, a dense factorization takes less time than launching kernels
LARGEST_DIRECT = 8192  # pixels: above, a dense factorization is no help in need any more


def plan(S: Operator, rtol: float) -> tuple[list[str], str]:
    """The methods to try for S x = b to `rtol`, in order, and the reason for the first in words.

    One product tells the row sums of R, and with them a bound on rho(R): far below 1 the plain iteration
    needs no more products than Chebyshev and no bounds; elsewhere Chebyshev with the free bounds needs
    fewest, and converges where the plain iteration does not. The bounds are those of Lambertian scenes; for
    others there is the dense factorization, as long as it is of any use.
    """
    n = S.shape[0]
    if n <= SMALL:
        return ["direct"], f"{n} pixels are few enough for a dense factorization"
    if rtol < 1e-6:
        return ["direct"], f"rtol={rtol:g} is below what float32 products reach"
    in_need = ["direct"] if n <= LARGEST_DIRECT else []
    rho = float(np.max(np.abs(S.row_sums() - 1.0)))
    plain = theory.series_products(rho, rtol)
    chebyshev = theory.chebyshev_products(*theory.free_bounds(S), rtol)
    known = f"row sums of R are at most {rho:.2g}"
    if plain <= chebyshev:
        return ["jacobi", "chebyshev", *in_need], f"{known}: {plain} products, chebyshev {chebyshev}"
    return ["chebyshev", *in_need], f"{known}: {chebyshev} products"
