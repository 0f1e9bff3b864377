# SPDX-License-Identifier: BSD-3-Clause
"""Conjugate gradients: the fewest products of all methods where S is self-adjoint.

Of a Lambertian scene, S is self-adjoint in the inner product <x, y> = sum_i w_i x_i y_i with w = area /
albedo: the transport T is symmetric (reciprocity) up to areas, and the first bounce F proportional to the
albedo, so that with pixels of equal area w = 1 / F does for S = T F^-1: the default where S comes from a
transport. Elsewhere it is w = 1, that of one albedo. Any other S is solved with its normal equations
S^T S x = S^T b (CGNR), at two products a step and the square of the condition number.

Each right-hand side has coefficients of its own and rests once it is solved. Two or three inner products
a step are read back.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithms 6.18 and 8.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator
from ltcl.solvers.columns import ratio
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_ORTHOGONAL = 2.0**-20  # ||S^T r|| / (||S|| ||r||), below which float32 makes the rest of S^T r


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
        if not isinstance(self.normal, (bool, np.bool_)):
            raise InputTypeError(f"normal is {self.normal!r}; it must be True or False")
        if self.weights is None:
            return
        if self.normal:
            raise InputError("weights are of no use with normal=True; give one of them")
        weights = checks.finite("weights", checks.real("weights", self.weights))
        if not np.all(weights > 0):
            raise InputError(
                f"weights has {np.sum(~(weights > 0))} value(s) that are not positive; all must be"
            )

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if self.normal:
            _normal_equations(system, x, r, monitor)
        else:
            _conjugate_gradients(system, x, r, monitor, _Inner(system, self.inner(system.S)))

    def inner(self, S: Operator) -> Any:
        """The weights of the inner product that a solve with S has, (N,), or None of the plain one."""
        if self.normal:
            return None
        return S.weights if self.weights is None else self.weights


class _Inner:
    """<x, y> = sum_i w_i x_i y_i of every column, in units of the largest weight."""

    def __init__(self, system: System, weights: Any) -> None:
        self._w = None
        if weights is not None:
            w = checks.shape("weights", np.asarray(weights, np.float64), system.b.shape[:1])
            self._w = system.S.device.upload(w / w.max())
            self._weighted = system.b.like()

    def __call__(self, x: Array, y: Array) -> np.ndarray:
        return vectors.dot(x, y if self._w is None else vectors.scale_rows(self._w, y, self._weighted))

    def square(self, r: Array, norms: np.ndarray) -> np.ndarray:
        """<r, r>, where the Euclidean `norms` of r are known."""
        return norms**2 if self._w is None else self(r, r)


def _conjugate_gradients(system: System, x: Array, r: Array, monitor: Monitor, inner: _Inner) -> None:
    p, q = r.copy(), r.like()  # 1.
    broken = np.zeros(r.columns, bool)
    square = None
    while not monitor.done(x, r, replace=True):
        step = monitor.unsolved & ~broken
        previous, square = square, inner.square(r, monitor.norms)
        if previous is not None:
            beta = ratio(square, previous, step)  # 6.
            vectors.axpby_columns(step, r, np.where(step, beta, 1.0), p, p)  # 7.
        system.apply(p, q)
        curvature = inner(q, p)
        broken |= step & (curvature <= 0.0)
        step &= ~broken
        if not step.any() and broken.any():
            return monitor.give_up(Status.INDEFINITE)
        alpha = ratio(square, curvature, step)  # 3.
        vectors.axpby_columns(alpha, p, 1.0, x, x)  # 4.
        vectors.axpby_columns(-alpha, q, 1.0, r, r)  # 5.
    return None


def _normal_equations(system: System, x: Array, r: Array, monitor: Monitor) -> None:
    z, p, w = r.like(), r.like(), r.like()
    broken = np.zeros(r.columns, bool)
    square, largest = None, np.zeros(r.columns)
    while not monitor.done(x, r, replace=True):
        step = monitor.unsolved & ~broken
        system.apply_transpose(r, z)  # 1. and 6.
        previous, square = square, vectors.dot(z, z)
        largest = np.maximum(largest, ratio(square, monitor.norms**2, step))  # of ||S||^2, from below
        # Least squares: r is orthogonal to all that S can make. More steps are rounding, and make x grow.
        broken |= step & (square <= largest * (_ORTHOGONAL * monitor.norms) ** 2)
        step &= ~broken
        if not step.any() and broken.any():
            return monitor.give_up(Status.BREAKDOWN)
        beta = np.zeros_like(square) if previous is None else ratio(square, previous, step)  # 7.
        vectors.axpby_columns(1.0, z, beta, p, p)  # 8.
        system.apply(p, w)  # 3.
        alpha = ratio(square, vectors.dot(w, w), step)  # 4.
        vectors.axpby_columns(alpha, p, 1.0, x, x)  # 5.
        vectors.axpby_columns(-alpha, w, 1.0, r, r)
    return None
