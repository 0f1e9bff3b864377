# SPDX-License-Identifier: BSD-3-Clause
"""Solves on the coefficients of a compressed S = I + W^T C W in an isometric basis W.

If W is orthonormal, S x = b is (I + C) a = W b with x = W^T a: two transforms for a whole solve. If
W has only some coefficients of such a basis, S is the identity on the others, and

    x = b + W^T (a - W b)
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

from ltcl.device import Array, vectors
from ltcl.operators import Compressed, IdentityPlus, Operator
from ltcl.operators.bases import Basis

_operators: weakref.WeakKeyDictionary[Operator, IdentityPlus] = weakref.WeakKeyDictionary()


@dataclass(frozen=True, kw_only=True, eq=False)
class CoefficientSpace:
    """The basis W, and I + C on its coefficients."""

    basis: Basis
    operator: IdentityPlus

    @staticmethod
    def exists(S: Operator) -> bool:
        """Return whether S is I + W^T C W with one isometric basis on both sides."""
        return isinstance(S, IdentityPlus) and isinstance(S.R, Compressed) and S.R.two_sided

    @classmethod
    def from_operator(cls, S: Operator) -> CoefficientSpace:
        """Return the space of an S for which it exists; what is learnt of I + C serves all solves."""
        assert isinstance(S, IdentityPlus)  # noqa: S101 - as `exists` tells
        assert isinstance(S.R, Compressed)  # noqa: S101
        assert S.R.into is not None  # noqa: S101
        if S not in _operators:
            operator = IdentityPlus(S.R.core, S.sign)
            operator.weights = S.weights
            # The row sums in pixels bound the spectrum.
            operator._row_sums = S.row_sums()
            _operators[S] = operator
        return cls(basis=S.R.into, operator=_operators[S])

    def to_pixels(self, a: Array, right: Array, b: Array) -> Array:
        """Convert the solution `a` of (I + C) a = right = W b to pixels."""
        if self.basis.orthonormal:
            return self.basis.apply_transpose(a)
        difference = vectors.axpby(1.0, a, -1.0, right, a.like())
        return self.basis.apply_transpose(difference, add=b)
