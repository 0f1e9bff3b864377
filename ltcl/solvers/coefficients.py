# SPDX-License-Identifier: BSD-3-Clause
"""Solves with S = I + W^T C W in the orthonormal basis W: (I + C) a = W b, and x = W^T a.

Two transforms in all, where pixels take two for every product. Lengths stay what they are, since W keeps
them: residuals, tolerances and steps are those of pixels up to rounding, and so is the spectrum; the row sums
that bound it stay those of S in pixels.

Where W has but some coefficients of an orthonormal basis, those that C acts on (`ltcl.operators.Selected`),
W W^T = I, but W^T W b is only a part of b. S is the identity on the rest, so that

    (I + C) a = W b,    x = b + W^T (a - W b)

is the solution, exactly. The residual of such an x is that of a, whatever it starts from; tolerances remain
relative to the whole of b. Products then take as many numbers as C has rows that are not empty.

Methods that read rows read those of I + C, where the core is CSR or dense: a sweep of Gauss-Seidel, SOR or
Southwell is then over coefficients, from the first to the last, and Jacobi's splitting is the same in any
basis. Their iterates are others than in pixels; where S is self-adjoint in the plain inner product so is
I + C, and they converge as there.

Not everything moves. The inner product of `cg` with weights, diagonal in pixels, is not so in coefficients:
it runs in pixels. So do methods that sample; they read rows of R itself, which a compressed S does not have,
and refuse: walks over coefficients would estimate these, and the standard errors of pixels would take the
squares of W.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array, vectors
from ltcl.operators import Compressed, IdentityPlus, Operator
from ltcl.operators.bases import Basis
from ltcl.solvers.cg import CG
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, Rule, System


class OnCoefficients(IdentityPlus):
    """I + sign C of S = I + sign W^T C W. `row_sums` and `weights` are those of S in pixels.

    Row sums bound a spectrum, which the two share, and are of no use for anything else.
    """

    def __init__(self, S: IdentityPlus, core: Operator) -> None:
        super().__init__(core, S.sign)
        self.weights = S.weights
        self._in_pixels = S

    def row_sums(self) -> np.ndarray:
        """S 1 in pixels, (N,) float32."""
        return self._in_pixels.row_sums()


@dataclass(frozen=True)
class Space:
    """Where a solve runs: S there, and the basis that leads there, None where that is pixels."""

    S: Operator
    W: Basis | None = None

    def enter(self, x: Array) -> Array:
        """W x."""
        return x if self.W is None else self.W.apply(x)

    def leave(self, a: Array, entered: Array, b: Array) -> Array:
        """W^T a, and the part of b beside it that W, with W b = `entered`, has no coefficients of."""
        if self.W is None or self.W.orthonormal:
            return a if self.W is None else self.W.apply_transpose(a)
        return self.W.apply_transpose(vectors.difference(a, entered, a.like()), add=b)


def space(S: Operator, method: Any) -> Space:
    """Coefficients, where S has them and `method` can use them; else pixels."""
    if not (isinstance(S, IdentityPlus) and isinstance(S.R, Compressed) and S.R.two_sided):
        return Space(S)
    if isinstance(method, CG) and method.inner(S) is not None:
        return Space(S)
    return Space(OnCoefficients(S, S.R.core), S.R.into)


def iterate(method: Any, S: Operator, b: Array, guess: Array | None, rule: Rule) -> tuple[Array, Monitor]:
    """Run an iterative method on S x = b; the iterate to return, in pixels, and what watched it."""
    where = space(S, method)
    system = System(where.S, where.enter(b), b)
    x, r = start(system, None if guess is None else where.enter(guess))
    monitor = Monitor(system, rule)
    method.iterate(system, x, r, monitor)
    best = x if monitor.status is Status.CONVERGED or monitor.best is None else monitor.best
    return where.leave(best, system.b, b), monitor


def start(system: System, guess: Array | None) -> tuple[Array, Array]:
    """The first iterate, which is the guess, and its residual; that of zero is b and costs no product."""
    if guess is None:
        return vectors.fill(system.b.like(), 0.0), system.b.copy()
    return guess, system.residual(guess, system.b.like())
