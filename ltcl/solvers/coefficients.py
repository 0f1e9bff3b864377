# SPDX-License-Identifier: BSD-3-Clause
"""Solves on the coefficients of a compressed S = I + W^T C W in an isometric basis W.

If W is orthonormal, S x = b is (I + C) a = W b with x = W^T a: two transforms for a whole solve. If
W has only some coefficients of such a basis, S is the identity on the others, and

    x = b + W^T (a - W b)
"""

from __future__ import annotations

from dataclasses import dataclass

from ltcl.device import Array, vectors
from ltcl.operators import Operator
from ltcl.operators.bases import Basis


@dataclass(frozen=True, kw_only=True, eq=False)
class CoefficientSpace:
    """The basis W, and I + C on its coefficients."""

    basis: Basis
    operator: Operator

    def to_pixels(self, a: Array, right: Array, b: Array) -> Array:
        """Convert the solution `a` of (I + C) a = right = W b to pixels."""
        if self.basis.orthonormal:
            return self.basis.apply_transpose(a)
        difference = vectors.axpby(1.0, a, -1.0, right, a.like())
        return self.basis.apply_transpose(difference, add=b)
