# SPDX-License-Identifier: BSD-3-Clause
"""Operators made of others: S = I + R, A diag(d) - diag(s), W_out^T C W_in, coupled colours, SciPy's."""

from __future__ import annotations

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


class IdentityPlus(Operator):
    """S = I + R, the interreflection operator (eq. 6), or I - A with ``sign=-1``; the identity is not stored.

    S^-1 undoes all bounces, (I - A)^-1 adds them (eq. 4 and 7).

    Parameters
    ----------
    R : Operator, (N, N)
    sign : 1 or -1
    weights : (N,), optional, all positive, see `Operator`
    solution_error : float
        ``||S^-1|| ||E||`` with E what was dropped; infinite where nothing is known. Also the `error_bound`.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense, IdentityPlus
    >>> S = IdentityPlus(Dense(ltcl.open_device(), [[0.0, 0.5], [0.5, 0.0]]))
    >>> (S @ numpy.array([1.0, 0.0])).tolist()
    [1.0, 0.5]
    """

    def __init__(
        self, R: Operator, sign: float = 1.0, weights: Any = None, *, solution_error: float = 0.0
    ) -> None:
        if R.shape[0] != R.shape[1]:
            raise InputError(f"R has shape {R.shape}; S = I + R needs a square one")
        if sign not in (1.0, -1.0):
            raise InputError(f"sign is {sign!r}; it must be 1 for I + R or -1 for I - R")
        if not solution_error >= 0.0:
            raise InputError(
                f"solution_error is {solution_error!r}; it must be a number of at least 0"
            )
        super().__init__(R.device, R.shape, R)
        self.R, self.sign, self.error, self.solution_error = (
            R,
            float(sign),
            R.error,
            float(solution_error),
        )
        self.error_bound = self.solution_error
        self.weights = None if weights is None else checks.shape("weights", weights, R.shape[:1])

    def diagonal(self) -> np.ndarray:
        """1 + sign diag(R), (N,) float64."""
        return 1.0 + self.sign * self.R.diagonal()

    def as_it_stands(self) -> IdentityPlus:
        """The same S taken for exact."""
        return self if self.solution_error == 0.0 else IdentityPlus(self.R, self.sign, self.weights)

    def _dense(self) -> np.ndarray:
        dense = self.R.to_dense()
        dense *= self.sign
        dense[np.diag_indices_from(dense)] += 1.0
        return dense

    def _bound(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        a, b, y, c = epilogue
        return self.R._bound(x, out, Epilogue(a * self.sign, b, y, c + a), transpose)

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Those of R with the identity in the same launch; see `Operator.stepper`."""
        return self.R.stepper(x, r, slots, a * self.sign, c + a)


class ScaledColumns(Operator):
    """A diag(d) - diag(shift): T = S F (eq. 3) of S and the first bounce, R = T F^-1 - I of T.

    A is (M, N), d (N,), shift a number or (N,), which needs a square A where it is not 0.
    """

    def __init__(self, A: Operator, d: np.ndarray, shift: Any = 0.0) -> None:
        self.d = checks.finite("d", checks.shape("d", checks.real("d", d), A.shape[1:]))
        self.shift = checks.shape("shift", checks.real("shift", shift), (), A.shape[:1]).astype(
            np.float64
        )
        if self.shift.any() and A.shape[0] != A.shape[1]:
            raise InputError(
                f"the operator has shape {A.shape}; A - diag(shift) needs a square one"
            )
        self.A, self._d = A, A.device.upload(self.d)
        self._shift = A.device.upload(self.shift) if self.shift.ndim else None
        super().__init__(A.device, A.shape, A, self._d, self._shift)
        self.error = A.error * float(np.max(np.abs(self.d), initial=0.0))
        if not self.shift.any():
            errors = (A.solution_error, A.error_bound)
            self.solution_error, self.error_bound = (
                error and error * spread(self.d) for error in errors
            )

    def diagonal(self) -> np.ndarray:
        """diag(A) d - shift, (min(M, N),) float64."""
        diagonal = self.A.diagonal()
        return diagonal * self.d[: len(diagonal)] - self.shift

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        if transpose:
            product = self.device.empty(out.shape)
            self.A._product(x, product, Epilogue(a), True)
            vectors.scale_rows(self._d, product, product)
            vectors.axpby(1.0, product, b, product if y is None else y, out)
        else:
            self.A._product(vectors.scale_rows(self._d, x, x.like()), out, Epilogue(a, b, y), False)
        if self._shift is not None:
            vectors.axpy(-a, vectors.scale_rows(self._shift, x, x.like()), out)
        else:
            c -= a * float(self.shift)
        if c:
            vectors.axpy(c, x, out)


def spread(d: np.ndarray) -> float:
    """max |d| / min |d|, what a diagonal may change relative errors by; infinite where some d is 0."""
    sizes = np.abs(np.asarray(d, np.float64))
    least = float(np.min(sizes, initial=np.inf))
    return float(np.max(sizes, initial=0.0)) / least if least > 0.0 else math.inf


class Compressed(Operator):
    """R = W_out^T C W_in, (M, N): a sparse core C between two bases; a side without one is of pixels.

    W on the right alone are the wavelet rows of the paper (section 6). Where both are one isometric
    basis, R has the norm, the spectrum (and 0 with it) and the solves of its core; see
    `ltcl.solvers.solve`.

    Parameters
    ----------
    core : Operator, (coefficients of out, coefficients of into)
    out, into : Basis or None
        None of pixels. `two_sided` tells whether both are one isometric basis.
    error : float, optional
        Bound on the 2-norm of what was dropped; that of the core when not given.
    diagonal : (min(M, N),), optional

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Compressed, Dense, Wavelet
    >>> device = ltcl.open_device()
    >>> W = Wavelet(device, (2, 2), "haar")
    >>> R = Compressed(
    ...     Dense(device, numpy.diag([0.5, 0, 0, 0])), W, W, error=1e-3
    ... )  # of each the mean, half
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
                raise InputError(
                    f"{name} is on another device, {W.device}; it must be on {core.device}"
                )
            shape.append(count if W is None else W.shape[1])
        super().__init__(core.device, (shape[0], shape[1]), core, out, into)
        self.core, self.out, self.into = core, out, into
        if error is None and core.error and not all(W is None or W.isometric for W in (out, into)):
            raise InputError(
                f"error is None; it must be given, as {core.error:.3g} is that of coefficients"
            )
        self.error = core.error if error is None else checks.number("error", error, least=0.0)
        self.two_sided = out is into and out is not None and out.isometric
        self.known_diagonal: np.ndarray | None = None
        if diagonal is not None:
            diagonal = checks.shape(
                "diagonal", checks.real("diagonal", diagonal), (min(self.shape),)
            )
            self.known_diagonal = checks.finite("diagonal", diagonal).astype(np.float64)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64: as given, else by products of at most 4096."""
        if self.known_diagonal is None:
            if self.out is None and self.into is None:
                return self.core.diagonal()
            if (n := min(self.shape)) > _FEW:
                raise InputError(
                    f"the diagonal of a compressed operator of {n} pixels takes as many products; make it "
                    "with diagonal=, or give first_bounce as an array (N,)"
                )
            self.known_diagonal = np.diagonal(self.to_dense()).copy()
        return self.known_diagonal

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        first, last = (self.out, self.into) if transpose else (self.into, self.out)
        if first is None and last is None:
            self.core._product(x, out, epilogue, transpose)
            return
        a, b, y, c = epilogue.without_shift(x)
        factors = [
            (A, t)
            for A, t in ((first, False), (self.core, transpose), (last, True))
            if A is not None
        ]
        operand = x
        for A, transposed in factors[:-1]:
            product = self.device.empty((A.shape[transposed], *x.shape[1:]))
            A._product(operand, product, PLAIN, transposed)
            operand = product
        A, transposed = factors[-1]
        A._product(operand, out, Epilogue(a, b, y), transposed)
        if c:
            vectors.axpy(c, x, out)


class Coupled(Operator):
    """picture_c = sum_j T_cj light_j with light_j = sum_i M_ji x_i, channel below channel: (3 M, 3 N).

    `blocks` are 3 x 3 operators (M, N), None of zeros; `mixing` is M, (3, 3), or the identity.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Coupled, Dense
    >>> grey = Dense(ltcl.open_device(), [[0.5]])
    >>> A = Coupled.mixed([grey] * 3, numpy.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]))
    >>> print(A @ numpy.array([1.0, 1.0, 2.0]))
    [0.55 0.5  1.  ]
    """

    def __init__(
        self, blocks: Sequence[Sequence[Operator | None]], mixing: np.ndarray | None = None
    ) -> None:
        own = [block for row in blocks for block in row if block is not None]
        if [len(row) for row in blocks] != [3, 3, 3] or len({block.shape for block in own}) != 1:
            raise InputError("blocks must be 3 x 3 operators of one shape, or None")
        rows, columns = own[0].shape
        super().__init__(own[0].device, (3 * rows, 3 * columns), *own)
        self.blocks, self.mixing = (
            blocks,
            np.eye(3) if mixing is None else np.asarray(mixing, np.float64),
        )
        self.error = max(float(np.abs(self.mixing).sum()), 1.0) * sum(block.error for block in own)

    @classmethod
    def mixed(cls, operators: Sequence[Operator], mixing: np.ndarray) -> Coupled:
        """Channels that see only their own light, which is mixed before."""
        return cls(
            [[T if c == j else None for j in range(3)] for c, T in enumerate(operators)], mixing
        )

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        width, height = x.shape[0] // 3, out.shape[0] // 3
        light = [x.rows(i * width, width) for i in range(3)]
        light = light if transpose else _mixed(self.mixing, light)
        sums = [vectors.fill(self.device.empty((height, *out.shape[1:])), 0.0) for _ in range(3)]
        for i, j in np.ndindex(3, 3):
            block = self.blocks[j][i] if transpose else self.blocks[i][j]
            if block is not None:
                block._product(light[j], sums[i], Epilogue(a, 1.0, sums[i]), transpose)
        for i, total in enumerate(_mixed(self.mixing.T, sums) if transpose else sums):
            for factor, array in ((b, y), (c, x)):  # read before `out`, which may be y, is written
                if factor and array is not None:
                    vectors.axpy(factor, array.rows(i * height, height), total)
            out.set_rows(i * height, total)


def _mixed(M: np.ndarray, light: list[Array]) -> list[Array]:
    """sum_i M_ji x_i for each j."""
    halves = [vectors.axpby(row[0], light[0], row[1], light[1], light[0].like()) for row in M]
    return [vectors.axpy(row[2], light[2], half) for row, half in zip(M, halves, strict=True)]


class Host(Operator):
    """Somebody's own `scipy.sparse.linalg.LinearOperator`: each product goes through the host."""

    def __init__(self, device: Device, operator: Any) -> None:
        self.operator = scipy.sparse.linalg.aslinearoperator(operator)
        self._name = type(operator).__name__
        checks.real(self._name, np.zeros(0, self.operator.dtype))
        super().__init__(device, self.operator.shape)

    def diagonal(self) -> np.ndarray:
        """What the operator's own ``diagonal()`` gives."""
        diagonal = getattr(self.operator, "diagonal", None)
        if diagonal is None:
            raise InputError(f"{self._name} has no diagonal(); give first_bounce as an array (N,)")
        return np.asarray(diagonal(), np.float64)

    def product(self, x: np.ndarray, transpose: bool = False) -> np.ndarray:
        """A x or A^T x on the host, of x (N, k) float64; what is not real and finite is refused."""
        name = f"the product of {self._name}"
        try:
            product = (self.operator.T if transpose else self.operator).matmat(
                x
            )  # matvec drops masks
        except (
            NotImplementedError,
            TypeError,
        ) as error:  # what SciPy raises, the second for several columns
            if not transpose:
                raise
            raise InputError(f"{self._name} has no rmatvec; its transpose is unknown") from error
        return checks.finite(name, checks.real(name, product))

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        host, (a, b, y, c) = x.get().astype(np.float64), epilogue
        product = self.product(host.reshape(len(host), -1), transpose).reshape(out.shape)
        total = a * product + c * host if c else a * product
        out.set(total if y is None else total + b * y.get())
