# SPDX-License-Identifier: BSD-3-Clause
"""R = W_out^T C W_in: a sparse core C between two bases, and sums of operators.

A picture is taken to coefficients by W_in, the core acts on these, and the transpose of W_out makes a picture
of what it gives. Without a basis on a side, that side is of pixels: W on the right alone are the wavelet rows
of the paper (section 6). Where both are one orthonormal basis, or some coefficients of one, R has the norm,
the spectrum (and 0 beside it) and the solves of its core; see `ltcl.solvers.coefficients`.
"""

from __future__ import annotations

import threading

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.bases import Basis, Ordered
from ltcl.operators.selected import Selected

_FEW = 4096  # pixels: the diagonal of no more is found by as many products


class Compressed(Operator):
    """R = W_out^T C W_in, (M, N).

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

    Raises
    ------
    InputError
        Shapes that do not fit, parts on different devices, an error below 0 or not known.

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
        for name, basis, count in (("out", out, core.shape[0]), ("into", into, core.shape[1])):
            _refuse_misfit(name, basis, count, core)
        shape = tuple(n if W is None else W.shape[1] for W, n in zip((out, into), core.shape, strict=True))
        super().__init__(core.device, (shape[0], shape[1]))
        self.core, self.out, self.into = core, out, into
        self.error = _error(core, out, into) if error is None else checks.number("error", error, least=0.0)
        self.two_sided = out is into and out is not None and out.isometric
        self.known_diagonal = None if diagonal is None else _known(diagonal, min(self.shape))
        self._scratch: list[Array | None] = [None, None]
        self._lock = threading.Lock()  # a product must have the scratch to itself while it is queued

    @property
    def nbytes(self) -> int:
        """Bytes of the core and of what the bases store."""
        return self.core.nbytes + sum(W.nbytes for W in {self.out, self.into} if W is not None)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64: as given, of a core of pixels, or by products.

        Raises
        ------
        InputError
            It was not given, and there are too many pixels for a product each.
        """
        if self.known_diagonal is None:
            self.known_diagonal = self._find_diagonal()
        return self.known_diagonal

    def _find_diagonal(self) -> np.ndarray:
        if self.out is None and self.into is None:
            return self.core.diagonal()
        if self.out is self.into and isinstance(self.out, Ordered):
            return self.core.diagonal()[np.argsort(self.out.order)]
        if self.out is self.into and isinstance(self.out, Selected):
            diagonal = np.zeros(self.shape[0])
            diagonal[self.out.places] = self.core.diagonal()
            return diagonal
        n = min(self.shape)
        if n > _FEW:
            raise InputError(
                f"the diagonal of a compressed operator of {n} pixels takes as many products; make it with "
                "diagonal=, or give first_bounce as an array (N,)"
            )
        return np.diagonal(self.to_dense()).copy()

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        first, last = (self.out, self.into) if transpose else (self.into, self.out)
        rows, columns = self.core.shape[::-1] if transpose else self.core.shape
        with self._lock:
            if first is not None:
                coefficients = self._room(0, columns, x)
                first._product(x, coefficients, 1.0, None, False)
                x = coefficients
            if last is None:
                self.core._product(x, out, scale, add, transpose)
                return
            product = self._room(1, rows, x)
            self.core._product(x, product, 1.0, None, transpose)
            last._product(product, out, scale, add, True)

    def _room(self, place: int, count: int, like: Array) -> Array:
        """An array of `count` coefficients for the columns of `like`, kept until others are asked for."""
        found, shape = self._scratch[place], (count, *like.shape[1:])
        if found is None or found.shape != shape:
            found = self._scratch[place] = self.device.empty(shape)
        return found


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
        super().__init__(operators[0].device, shapes[0])
        self.operators = operators
        self.error = sum(A.error for A in operators)

    @property
    def nbytes(self) -> int:
        """Bytes of all operators."""
        return sum(A.nbytes for A in self.operators)

    def diagonal(self) -> np.ndarray:
        """The sum of the diagonals, (min(M, N),) float64."""
        return np.sum([A.diagonal() for A in self.operators], axis=0)

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        for A in self.operators:
            A._product(x, out, scale, add, transpose)
            add = out  # the following add to what the first has written


def _refuse_misfit(name: str, basis: Basis | None, count: int, core: Operator) -> None:
    if basis is None:
        return
    if basis.shape[0] != count:
        raise InputError(
            f"{name} has {basis.shape[0]} coefficients, but the core is {core.shape}; it must have {count}"
        )
    if basis.device is not core.device:
        raise InputError(f"{name} is on another device, {basis.device}; it must be on {core.device}")


def _error(core: Operator, *bases: Basis | None) -> float:
    if core.error and not all(W is None or W.isometric for W in bases):
        raise InputError(
            f"error is None, and the core's, {core.error:.3g}, is not that of R in a basis that is not "
            "isometric; it must be given"
        )
    return core.error


def _known(diagonal: np.ndarray, n: int) -> np.ndarray:
    found = checks.finite("diagonal", checks.shape("diagonal", checks.real("diagonal", diagonal), (n,)))
    return found.astype(np.float64)
