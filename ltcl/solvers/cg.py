# SPDX-License-Identifier: BSD-3-Clause
"""Conjugate gradients: the fewest products of all methods where S is self-adjoint.

Of a Lambertian scene, S is self-adjoint in the inner product <x, y> = sum_i w_i x_i y_i with w = area /
albedo: the transport T is symmetric (reciprocity) up to areas, and the first bounce F proportional to the
albedo, so that with pixels of equal area w = 1 / F does for S = T F^-1: the default where S comes from a
transport; else w = 1.

A step is a product, inner products, and one update of all vectors, by the recurrences of Chronopoulos and
Gear (J. Comput. Appl. Math. 25, 1989, section 3): with w = S r, <p, S p> = <w, r> - beta <r, r> / alpha.
Coefficients stay on the device.
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

_PAIRS = 0b0001_0000  # <r, r> and <w, r>, of arrays r, w
_BROKEN = 2, 6  # rows of the state, of even and of odd steps
_STEP, _ANEW = 3, 4  # arguments of the update


@dataclass(frozen=True)
class CG:
    """Options: ``weights`` of the inner product."""

    name: ClassVar[str] = "cg"
    weights: Any = None

    def __post_init__(self) -> None:
        if self.weights is None:
            return
        few = int(np.sum(~(checks.finite("weights", checks.real("weights", self.weights)) > 0)))
        if few:
            raise InputError(f"weights has {few} value(s) that are not positive; all must be")

    def inner(self, S: Operator) -> Any:
        """The weights of the inner product that a solve with S has, (N,), or None of the plain one."""
        return S.weights if self.weights is None else self.weights

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        weights = self._weights(system, r)
        columns = Columns(r, "krylov", "krylov_pairs", "krylov_cg")
        w, p, q = r.like(), vectors.fill(r.like(), 0.0), vectors.fill(r.like(), 0.0)
        state, sums = columns.state(), columns.sums(2)
        rest = r.device.upload(~monitor.unsolved, np.int32)
        pairs = (_PAIRS, int(weights is not r), weights, r, w, w, sums)
        moves = (columns.slices, 0, 1, rest, sums, state, w, p, q, x, r)
        update = columns.bind("krylov_cg", *moves, extra=2)
        queued = [system.S.bind(r, w), columns.bind("krylov_pairs", *pairs, across=2), update]
        step, unsolved, anew = 0, monitor.unsolved, 1
        while True:
            steps = range(step, step + monitor.steps_ahead())
            for step in steps:
                update.set(_STEP, step)
                update.set(_ANEW, anew)
                for launch in queued:
                    launch()
                anew = 0
            system.products += len(steps)
            step = steps.stop
            numbers, norms = columns.read(state, steps.start, step)
            if monitor.check(x, r, norms, np.inf):
                return
            broken = numbers[_BROKEN[step % 2]] > 0.0
            if broken.any() and broken[monitor.unsolved].all():
                monitor.status = Status.INDEFINITE
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
