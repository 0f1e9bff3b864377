# SPDX-License-Identifier: BSD-3-Clause
"""Operators made of others: S = I + R, columns scaled by a diagonal, and operators that live on the host."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Operator


class IdentityPlus(Operator):
    """S = I + R, the interreflection operator (eq. 6), or I - A with ``sign=-1``; the identity is not stored.

    The two are the paper's duality: S^-1 undoes all bounces, (I - A)^-1 adds them (eq. 4 and 7), and a
    solver cannot tell them apart.

    Parameters
    ----------
    R : Operator, (N, N)
        Global illumination R, or one bounce A.
    sign : float
        +1 for I + R, -1 for I - R.
    weights : (N,), optional
        All positive: S is self-adjoint in the inner product <x, y> = sum_i w_i x_i y_i, as far as is known.
    solution_error : float
        What solutions with a compressed R may be off by: ``||S^-1|| ||E||``, E what was dropped. Infinite
        where nothing is known.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense, IdentityPlus
    >>> S = IdentityPlus(Dense(ltcl.open_device(), [[0.0, 0.5], [0.5, 0.0]]))
    >>> (S @ numpy.array([1.0, 0.0])).tolist()
    [1.0, 0.5]
    """

    def __init__(
        self,
        R: Operator,
        sign: float = 1.0,
        weights: np.ndarray | None = None,
        *,
        solution_error: float = 0.0,
    ) -> None:
        if R.shape[0] != R.shape[1]:
            raise InputError(f"R has shape {R.shape}; S = I + R needs a square one")
        if sign not in (1.0, -1.0):
            raise InputError(f"sign is {sign!r}; it must be 1 for I + R or -1 for I - R")
        if not solution_error >= 0.0:
            raise InputError(f"solution_error is {solution_error!r}; it must be a number of at least 0")
        super().__init__(R.device, R.shape)
        self.R = R
        self.sign = float(sign)
        self.solution_error = float(solution_error)
        self.error = R.error
        self.weights = None if weights is None else checks.shape("weights", weights, R.shape[:1])

    @property
    def nbytes(self) -> int:
        """Bytes of R."""
        return self.R.nbytes

    def diagonal(self) -> np.ndarray:
        """1 + sign diag(R), (N,) float64."""
        return 1.0 + self.sign * self.R.diagonal()

    def as_it_stands(self) -> IdentityPlus:
        """The same S taken for exact: what is asked of it is asked of no other."""
        return self if self.solution_error == 0.0 else IdentityPlus(self.R, self.sign, self.weights)

    def to_dense(self) -> np.ndarray:
        """I + sign R, (N, N) float64, on the host."""
        dense = self.R.to_dense()
        dense *= self.sign
        dense[np.diag_indices_from(dense)] += 1.0
        return dense

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        # Where something is added anyway, x joins it afterwards; else x itself is what R x is added to.
        if add is None and scale == 1.0:
            self.R._product(x, out, self.sign, x, transpose)
        else:
            self.R._product(x, out, scale * self.sign, add, transpose)
            vectors.axpy(scale, x, out)


class ScaledColumns(Operator):
    """A diag(d): T from S and the first bounce, T = S F (eq. 3), or the other way round with 1 / F."""

    def __init__(self, A: Operator, d: np.ndarray) -> None:
        super().__init__(A.device, A.shape)
        self.A = A
        self.d = checks.finite("d", checks.shape("d", checks.real("d", d), A.shape[1:]))
        self._d = A.device.upload(self.d)
        self.error = A.error * float(np.max(np.abs(self.d), initial=0.0))
        self.solution_error = A.solution_error and A.solution_error * spread(self.d)

    @property
    def nbytes(self) -> int:
        """Bytes of the matrix and of the diagonal."""
        return self.A.nbytes + self._d.nbytes

    def diagonal(self) -> np.ndarray:
        """diag(A) d, (min(M, N),) float64."""
        diagonal = self.A.diagonal()
        return diagonal * self.d[: len(diagonal)]

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if not transpose:
            self.A._product(vectors.scale_rows(self._d, x, x.like()), out, scale, add, False)
            return
        product = self.A.device.empty(out.shape)
        self.A._product(x, product, scale, None, True)
        vectors.scale_rows(self._d, product, product)
        if add is None:
            out.copy_from(product)
        else:
            vectors.axpby(1.0, product, 1.0, add, out)


def spread(d: np.ndarray) -> float:
    """max |d| / min |d|, what a diagonal may change relative errors by; infinite where some d is 0.

    >>> spread(np.array([0.5, -2.0])), spread(np.array([0.0, 1.0]))
    (4.0, inf)
    """
    sizes = np.abs(np.asarray(d, np.float64))
    least = float(np.min(sizes, initial=np.inf))
    return float(np.max(sizes, initial=0.0)) / least if least > 0.0 else math.inf


class Shifted(Operator):
    """A - I: turns any square S into the R of S = I + R; or A - diag(d), 0 in d where a pixel is masked."""

    def __init__(self, A: Operator, d: np.ndarray | None = None) -> None:
        if A.shape[0] != A.shape[1]:
            raise InputError(f"the operator has shape {A.shape}; A - I needs a square one")
        super().__init__(A.device, A.shape)
        self.A = A
        self.d = np.ones(A.shape[0]) if d is None else checks.shape("d", checks.real("d", d), A.shape[:1])
        self._d = None if d is None else A.device.upload(self.d)
        self.error = A.error

    @property
    def nbytes(self) -> int:
        """Bytes of A."""
        return self.A.nbytes

    def diagonal(self) -> np.ndarray:
        """diag(A) - d, (N,) float64."""
        return self.A.diagonal() - self.d

    def to_dense(self) -> np.ndarray:
        """A - diag(d), (N, N) float64, on the host."""
        dense = self.A.to_dense()
        dense[np.diag_indices_from(dense)] -= self.d
        return dense

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        self.A._product(x, out, scale, add, transpose)
        kept = x if self._d is None else vectors.scale_rows(self._d, x, x.like())
        vectors.axpy(-scale, kept, out)


class Host(Operator):
    """Somebody's own `scipy.sparse.linalg.LinearOperator`: each product goes through the host.

    Slow beside the others, but everything that takes an operator takes it.
    """

    def __init__(self, device: Device, operator: Any) -> None:
        self.operator = scipy.sparse.linalg.aslinearoperator(operator)
        checks.real(type(operator).__name__, np.zeros(0, self.operator.dtype))
        super().__init__(device, self.operator.shape)

    def diagonal(self) -> np.ndarray:
        """Asked of the operator, where it can tell; else one product per pixel would be needed: refused."""
        diagonal = getattr(self.operator, "diagonal", None)
        if callable(diagonal):
            return np.asarray(diagonal(), np.float64)
        raise InputError(
            f"{type(self.operator).__name__} has no diagonal(); give first_bounce as an array (N,)"
        )

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        host = x.get().astype(np.float64)
        name = type(self.operator).__name__
        act = self.operator.T if transpose else self.operator
        try:
            product = np.asarray(act @ host)
        except NotImplementedError as error:  # what SciPy raises
            raise InputError(f"{name} has no rmatvec, so products with its transpose are unknown") from error
        checks.finite(f"the product of {name}", checks.real(f"the product of {name}", product))
        out.set(scale * product if add is None else scale * product + add.get())
