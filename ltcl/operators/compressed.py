# SPDX-License-Identifier: BSD-3-Clause
"""A sparse core between two bases: R = W_out^T C W_in."""

from __future__ import annotations

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import PLAIN, Epilogue, Operator
from ltcl.operators.bases import Basis

MAX_DIAGONAL_PRODUCTS = 4096  # pixels: the diagonal of no more is found by as many products


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
            if (n := min(self.shape)) > MAX_DIAGONAL_PRODUCTS:
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
