# SPDX-License-Identifier: BSD-3-Clause
"""Rounding of float32 products, and how much of a residual it hides.

A residual b - S x in float32 deviates from the true one by at most about c eps || |S| || ||x||,
eps = 2^-23 (Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.5, with
random signs in place of the worst case). A claim rests on a residual that is within the tolerance
with this added; where it is not, S x is computed in float64 with the numbers that were given
(`Operator.product_float64`).
"""

from __future__ import annotations

EPS = 2.0**-23

# c eps. Measured for rows of CSR, dense and tiles: at most 0.1 eps for random signs. Sums of
# nonnegative numbers grow on the way: 0.3 eps at 64 a row, 0.5 at 4096, 0.8 at 16384 and 1.5 at
# 65536. UNIT is 2.7 times the worst of these, for rows longer than those measured.
UNIT = 4.0 * EPS

# c eps of float64.
UNIT_FLOAT64 = 4.0 * 2.0**-52
