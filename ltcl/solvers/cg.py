# SPDX-License-Identifier: BSD-3-Clause
"""Conjugate gradients: the fewest products of all methods where S is self-adjoint.

Of a Lambertian scene, S is self-adjoint in the inner product <x, y> = sum_i w_i x_i y_i with w = area /
albedo: the transport T is symmetric (reciprocity) up to areas, and the first bounce F proportional to the
albedo, so that with pixels of equal area w = 1 / F does for S = T F^-1: the default where S comes from a
transport. Elsewhere it is w = 1, that of one albedo. Any other S is solved with its normal equations
S^T S x = S^T b (CGNR), at two products a step and the square of the condition number.

A step is a product (two of CGNR), inner products, and one update of all vectors, by the recurrences of
Chronopoulos and Gear, where both inner products come after the product: with w = S r,
<p, S p> = <w, r> - beta <r, r> / alpha. Coefficients stay on the device, and several steps
are queued between two readings of the residuals. Each right-hand side rests once it is solved.

Numbers in comments: Chronopoulos and Gear, J. Comput. Appl. Math. 25 (1989), section 3; for the normal
equations Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 8.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators import Operator
from ltcl.solvers.columns import Columns
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_PAIRS = 0b0001_0000  # <z, z> and <w, z>, of arrays z, w, r; left operand in the upper bits
_NORMAL_PAIRS = 0b1010_0101_0000  # <z, z>, <w, w> and <r, r>
_BROKEN = 2, 6  # rows of the state, of even and of odd steps
_STEP, _ANEW = 4, 5  # arguments of the update


@dataclass(frozen=True)
class CG:
    """Options of cg.

    Attributes
    ----------
    weights : (N,), optional
        Of the inner product in which S is self-adjoint, all positive, in any unit. When not given, the
        `weights` that S brings along, which of a transport are 1 / F; ones where it has none.
    normal : bool
        Solve the normal equations, which ask nothing of S but products with its transpose.
    """

    name: ClassVar[str] = "cg"
    weights: Any = None
    normal: bool = False

    def __post_init__(self) -> None:
        checks.flag("normal", self.normal)
        if self.weights is None:
            return
        if self.normal:
            raise InputError("weights cannot be combined with normal=True; give one of them")
        few = int(np.sum(~(checks.finite("weights", checks.real("weights", self.weights)) > 0)))
        if few:
            raise InputError(f"weights has {few} value(s) that are not positive; all must be")

    def inner(self, S: Operator) -> Any:
        """The weights of the inner product that a solve with S has, (N,), or None of the plain one."""
        if self.normal:
            return None
        return S.weights if self.weights is None else self.weights

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if monitor.check(x, r):
            return
        S, normal, weights = system.S, int(self.normal), self._weights(system, r)
        columns = Columns(r, "krylov", "krylov_pairs", "krylov_cg")
        w, p, q = r.like(), vectors.fill(r.like(), 0.0), vectors.fill(r.like(), 0.0)
        z = r.like() if normal else r
        state, sums = columns.state(), columns.sums(2 + normal)
        rest = r.device.upload(~monitor.unsolved, np.int32)
        codes = _NORMAL_PAIRS if normal else _PAIRS
        pairs = (codes, int(weights is not r), weights, z, w, r, sums)
        moves = (columns.slices, normal, 0, 1, rest, sums, state, z, w, p, q, x, r)
        update = columns.bind("krylov_cg", *moves, extra=2 + normal)
        queued = [S.bind(r, z, transpose=True)] if normal else []
        queued += [S.bind(z, w), columns.bind("krylov_pairs", *pairs, across=2 + normal), update]
        step, unsolved, anew = 0, monitor.unsolved, 1
        while True:
            first = step
            for _ in range(monitor.steps_ahead()):
                update.set(_STEP, step)
                update.set(_ANEW, anew)
                for launch in queued:
                    launch()
                step, anew = step + 1, 0
            system.products += (1 + normal) * (step - first)
            numbers, norms = columns.read(state, first, step)
            if monitor.check(x, r, norms, recursive=True):
                return
            broken = numbers[_BROKEN[step % 2]] > 0.0
            if broken.any() and broken[monitor.unsolved].all():
                monitor.give_up(Status.BREAKDOWN if normal else Status.INDEFINITE)
                return
            anew = int(not np.array_equal(monitor.norms, norms[-1]))  # r is the true residual now
            if (monitor.unsolved != unsolved).any():
                unsolved = monitor.unsolved
                rest.set(~unsolved)

    def _weights(self, system: System, r: Array) -> Array:
        """Of all values, in units of the largest one; `r` itself, which is not read, where there are none."""
        weights = self.inner(system.S)
        if weights is None:
            return r
        w = checks.shape("weights", np.asarray(weights, np.float64), system.b.shape[:1])
        return r.device.upload(np.broadcast_to((w / w.max()).reshape(-1, *[1] * (len(r.shape) - 1)), r.shape))
