# SPDX-License-Identifier: BSD-3-Clause
"""Operators made of others: S = I + R, A diag(d), A - I, sums, W_out^T C W_in, coupled colours, SciPy's."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError
from ltcl.operators.base import PLAIN, Epilogue, Operator, Stepper
from ltcl.operators.bases import Basis

_FEW = 4096  # pixels: the diagonal of no more is found by as many products
_COLOURS = range(3)


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
        super().__init__(R.device, R.shape, R)
        self.R, self.sign, self.error, self.solution_error = R, float(sign), R.error, float(solution_error)
        self.weights = None if weights is None else checks.shape("weights", weights, R.shape[:1])

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

    def _bound(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Callable[[], object]:
        a, b, y, c = epilogue
        return self.R._bound(x, out, Epilogue(a * self.sign, b, y, c + a), transpose)

    def _stepper(self, x: Array, r: Array, slots: int, a: float, c: float) -> Stepper:
        return self.R._stepper(x, r, slots, a * self.sign, c + a)


class ScaledColumns(Operator):
    """A diag(d): T from S and the first bounce, T = S F (eq. 3), or the other way round with 1 / F."""

    def __init__(self, A: Operator, d: np.ndarray) -> None:
        self.d = checks.finite("d", checks.shape("d", checks.real("d", d), A.shape[1:]))
        self.A, self._d = A, A.device.upload(self.d)
        super().__init__(A.device, A.shape, A, self._d)
        self.error = A.error * float(np.max(np.abs(self.d), initial=0.0))
        self.solution_error = A.solution_error and A.solution_error * spread(self.d)

    def diagonal(self) -> np.ndarray:
        """diag(A) d, (min(M, N),) float64."""
        diagonal = self.A.diagonal()
        return diagonal * self.d[: len(diagonal)]

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        if transpose:
            product = self.device.empty(out.shape)
            self.A._product(x, product, Epilogue(a), True)
            vectors.scale_rows(self._d, product, product)
            vectors.axpby(1.0, product, b, product if y is None else y, out)
        else:
            self.A._product(vectors.scale_rows(self._d, x, x.like()), out, Epilogue(a, b, y), False)
        if c:
            vectors.axpy(c, x, out)


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
        self.d = np.ones(A.shape[0]) if d is None else checks.shape("d", checks.real("d", d), A.shape[:1])
        self.A, self._d = A, None if d is None else A.device.upload(self.d)
        super().__init__(A.device, A.shape, A, self._d)
        self.error = A.error

    def diagonal(self) -> np.ndarray:
        """diag(A) - d, (N,) float64."""
        return self.A.diagonal() - self.d

    def to_dense(self) -> np.ndarray:
        """A - diag(d), (N, N) float64, on the host."""
        dense = self.A.to_dense()
        dense[np.diag_indices_from(dense)] -= self.d
        return dense

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        self.A._product(x, out, Epilogue(a, b, y, c - a if self._d is None else c), transpose)
        if self._d is not None:
            vectors.axpy(-a, vectors.scale_rows(self._d, x, x.like()), out)


class Sum(Operator):
    """A + B + ...: sharp parts in pixels, the smooth rest in wavelets.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense, Sum
    >>> device = ltcl.open_device()
    >>> R = Sum(Dense(device, [[0.0, 0.5], [0.0, 0.0]]), Dense(device, [[0.0, 0.0], [0.25, 0.0]]))
    >>> (R @ numpy.array([1.0, 1.0])).tolist()
    [0.5, 0.25]
    """

    def __init__(self, *operators: Operator) -> None:
        shapes = sorted({A.shape for A in operators})
        if len(shapes) != 1:
            raise InputError(f"a sum has operators of the shapes {shapes}; it must have some, of one shape")
        if len({A.device for A in operators}) > 1:
            raise InputError("a sum has operators on several devices; all must be on one")
        super().__init__(operators[0].device, shapes[0], *operators)
        self.operators = operators
        self.error = sum(A.error for A in operators)

    def diagonal(self) -> np.ndarray:
        """The sum of the diagonals, (min(M, N),) float64."""
        return np.sum([A.diagonal() for A in self.operators], axis=0)

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        for A in self.operators:
            A._product(x, out, epilogue, transpose)
            epilogue = Epilogue(epilogue.a, 1.0, out)  # the following add to what the first has written


class Compressed(Operator):
    """R = W_out^T C W_in, (M, N): a sparse core C between two bases; a side without one is of pixels.

    W on the right alone are the wavelet rows of the paper (section 6). Where both are one orthonormal basis,
    or some coefficients of one, R has the norm, the spectrum (and 0 with it) and the solves of its core; see
    `ltcl.solvers.refinement`.

    Parameters
    ----------
    core : Operator, (coefficients of out, coefficients of into)
        C.
    out, into : Basis or None
        W_out and W_in; None of pixels.
    error : float, optional
        Bound on the 2-norm of what was dropped; that of the core when not given.
    diagonal : (min(M, N),), optional
        Of R, where it is known: few cores tell it cheaply.

    Attributes
    ----------
    two_sided : bool
        Whether out and into are one isometric basis: then R is as good as its core.
    known_diagonal : (min(M, N),) float64 or None
        The diagonal as far as it was given or found.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Compressed, Dense, Wavelet
    >>> device = ltcl.open_device()
    >>> W = Wavelet(device, (2, 2), "haar")
    >>> R = Compressed(Dense(device, numpy.diag([0.5, 0, 0, 0])), W, W, error=1e-3)  # of each the mean, half
    >>> (R @ numpy.array([1.0, 2.0, 3.0, 6.0])).round(6).tolist(), R.error
    ([1.5, 1.5, 1.5, 1.5], 0.001)
    """

    def __init__(
        self,
        core: Operator,
        out: Basis | None,
        into: Basis | None,
        error: float | None = None,
        *,
        diagonal: np.ndarray | None = None,
    ) -> None:
        shape = []
        for name, W, count in (("out", out, core.shape[0]), ("into", into, core.shape[1])):
            if W is not None and W.shape[0] != count:
                raise InputError(
                    f"{name} has {W.shape[0]} coefficients, but the core {core.shape}; it must have {count}"
                )
            if W is not None and W.device is not core.device:
                raise InputError(f"{name} is on another device, {W.device}; it must be on {core.device}")
            shape.append(count if W is None else W.shape[1])
        super().__init__(core.device, (shape[0], shape[1]), core, out, into)
        self.core, self.out, self.into = core, out, into
        if error is None and core.error and not all(W is None or W.isometric for W in (out, into)):
            raise InputError(
                f"error is None, and the core's, {core.error:.3g}, is not that of R in a basis that is not "
                "isometric; it must be given"
            )
        self.error = core.error if error is None else checks.number("error", error, least=0.0)
        self.two_sided = out is into and out is not None and out.isometric
        self.known_diagonal: np.ndarray | None = None
        if diagonal is not None:
            diagonal = checks.shape("diagonal", checks.real("diagonal", diagonal), (min(self.shape),))
            self.known_diagonal = checks.finite("diagonal", diagonal).astype(np.float64)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64: as given, or by a product for each of a few pixels."""
        n = min(self.shape)
        if self.known_diagonal is not None:
            return self.known_diagonal
        if self.out is None and self.into is None:
            return self.core.diagonal()
        if n > _FEW:
            raise InputError(
                f"the diagonal of a compressed operator of {n} pixels takes as many products; make it with "
                "diagonal=, or give first_bounce as an array (N,)"
            )
        self.known_diagonal = np.diagonal(self.to_dense()).copy()
        return self.known_diagonal

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        first, last = (self.out, self.into) if transpose else (self.into, self.out)
        rows, columns = self.core.shape[::-1] if transpose else self.core.shape
        if first is None and last is None:
            self.core._product(x, out, epilogue, transpose)
            return
        a, b, y, c = epilogue.without_shift(x)
        product = x
        if first is not None:
            product = self.device.empty((columns, *x.shape[1:]))
            first._product(x, product, PLAIN, False)
        if last is not None:
            coefficients, product = product, self.device.empty((rows, *x.shape[1:]))
            self.core._product(coefficients, product, PLAIN, transpose)
            last._product(product, out, Epilogue(a, b, y), True)
        else:
            self.core._product(product, out, Epilogue(a, b, y), transpose)
        if c:
            vectors.axpy(c, x, out)


class Coupled(Operator):
    """picture_c = sum_j T_cj light_j with light_j = sum_i M_ji x_i, channel below channel: (3 M, 3 N).

    Parameters
    ----------
    blocks : 3 x 3 Operators or None
        T_cj, (M, N); None is zero.
    mixing : (3, 3), optional
        M; the identity when not given.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Coupled, Dense
    >>> grey = Dense(ltcl.open_device(), [[0.5]])
    >>> A = Coupled.mixed([grey] * 3, numpy.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]))
    >>> print(A @ numpy.array([1.0, 1.0, 2.0]))
    [0.55 0.5  1.  ]
    """

    def __init__(self, blocks: Sequence[Sequence[Operator | None]], mixing: np.ndarray | None = None) -> None:
        all_blocks = [block for row in blocks for block in row if block is not None]
        if [len(row) for row in blocks] != [3, 3, 3] or len({block.shape for block in all_blocks}) != 1:
            raise InputError("blocks must be 3 x 3 operators of one shape, or None")
        rows, columns = all_blocks[0].shape
        super().__init__(all_blocks[0].device, (3 * rows, 3 * columns), *all_blocks)
        self.blocks = [list(row) for row in blocks]
        self.mixing = np.eye(3) if mixing is None else np.asarray(mixing, np.float64)
        self.error = max(float(np.abs(self.mixing).sum()), 1.0) * sum(block.error for block in all_blocks)

    @classmethod
    def mixed(cls, operators: Sequence[Operator], mixing: np.ndarray) -> Coupled:
        """Channels that see only their own light, which is mixed before."""
        return cls([[T if c == j else None for j in _COLOURS] for c, T in enumerate(operators)], mixing)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (3 N,) float64, of square blocks."""
        if self.shape[0] != self.shape[1]:
            raise InputError(f"the blocks of a {self.shape} operator are not square; it has no diagonal")
        zero = np.zeros(self.shape[0] // 3)
        parts = [[zero if block is None else block.diagonal() for block in row] for row in self.blocks]
        return np.concatenate([self.mixing[:, c] @ np.stack(parts[c]) for c in _COLOURS])

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        parts = [x.rows(i * x.shape[0] // 3, x.shape[0] // 3) for i in _COLOURS]
        parts = parts if transpose else _mixed(self.mixing, parts)
        height = out.shape[0] // 3
        sums = [vectors.fill(self.device.empty((height, *out.shape[1:])), 0.0) for _ in _COLOURS]
        for to, of in itertools.product(_COLOURS, _COLOURS):
            block = self.blocks[of][to] if transpose else self.blocks[to][of]
            if block is not None:
                block._product(parts[of], sums[to], Epilogue(a, 1.0, sums[to]), transpose)
        for i, part in enumerate(_mixed(self.mixing.T, sums) if transpose else sums):
            if y is not None and b:  # read before `out`, which may be the same, is written
                vectors.axpy(b, y.rows(i * height, height), part)
            if c:
                vectors.axpy(c, x.rows(i * height, height), part)
            out.set_rows(i * height, part)


def _mixed(M: np.ndarray, parts: list[Array]) -> list[Array]:
    """sum_i M_ji x_i for each j."""
    halves = (vectors.axpby(row[0], parts[0], row[1], parts[1], parts[0].like()) for row in M)
    return [vectors.axpy(row[2], parts[2], half) for row, half in zip(M, halves, strict=True)]


class Host(Operator):
    """Somebody's own `scipy.sparse.linalg.LinearOperator`: each product goes through the host.

    Slow beside the others, but everything that takes an operator takes it.
    """

    def __init__(self, device: Device, operator: Any) -> None:
        self.operator = scipy.sparse.linalg.aslinearoperator(operator)
        self._name = type(operator).__name__
        checks.real(self._name, np.zeros(0, self.operator.dtype))
        super().__init__(device, self.operator.shape)

    def diagonal(self) -> np.ndarray:
        """Asked of the operator, where it can tell; else one product per pixel would be needed: refused."""
        diagonal = getattr(self.operator, "diagonal", None)
        if callable(diagonal):
            return np.asarray(diagonal(), np.float64)
        raise InputError(f"{self._name} has no diagonal(); give first_bounce as an array (N,)")

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        host, (a, b, y, c) = x.get().astype(np.float64), epilogue
        try:
            product = np.asarray((self.operator.T if transpose else self.operator) @ host)
        except (NotImplementedError, TypeError) as error:  # what SciPy raises, the second for several columns
            if not transpose:
                raise
            raise InputError(f"{self._name} has no rmatvec; its transpose is unknown") from error
        checks.finite(f"the product of {self._name}", checks.real(f"the product of {self._name}", product))
        total = a * product + c * host if c else a * product
        out.set(total if y is None else total + b * y.get())
