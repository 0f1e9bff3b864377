# SPDX-License-Identifier: BSD-3-Clause
"""A sparse core between two bases: R = W_out^T C W_in."""

from __future__ import annotations

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.device.kernels import Queued, in_order
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.bases import Basis
from ltcl.operators.dense import Dense
from ltcl.operators.epilogue import PLAIN, Epilogue
from ltcl.operators.knowledge import NormBound

# Pixels up to which the diagonal is found by as many products.
MAX_DIAGONAL_PRODUCTS = 4096


class Compressed(Operator):
    """R = W_out^T C W_in, (M, N): a sparse core C between two bases; a side without one is pixels.

    W on the right alone gives the wavelet rows of the paper (section 6). If both sides are one
    isometric basis, R has the norm, the spectrum (and 0 with it) and the solves of its core; see
    `ltcl.solvers.solve`.

    Parameters
    ----------
    core : Operator, (coefficients of out, coefficients of into)
    out, into : Basis or None
        None for pixels. `two_sided` tells whether both are one isometric basis.
    error : float, optional
        Bound on the 2-norm of what was dropped; that of the core when not given.
    diagonal : (min(M, N),), optional

    Examples
    --------
    The core keeps of each picture the mean, and half of it:

    >>> import ltcl, numpy
    >>> from ltcl.operators import Compressed, Dense, Wavelet
    >>> device = ltcl.open_device()
    >>> W = Wavelet(device, (2, 2), "haar")
    >>> core = Dense(device, numpy.diag([0.5, 0, 0, 0]))
    >>> R = Compressed(core, W, W, error=1e-3)
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
        rows = _pixels("out", out, core, core.shape[0])
        columns = _pixels("into", into, core, core.shape[1])
        super().__init__(core.device, (rows, columns), core, out, into)
        self.core = core
        self.out = out
        self.into = into
        self.two_sided = out is into and out is not None and out.isometric
        if self.two_sided:
            self.core_basis = into
        if error is not None:
            self.error = checks.number("error", error, least=0.0)
        elif core.error and not self._keeps_norms:
            raise InputError(
                f"error is None; it must be given, as {core.error:.3g} is that of coefficients"
            )
        else:
            self.error = core.error
        self.known_diagonal: np.ndarray | None = None
        if diagonal is not None:
            values = checks.real("diagonal", diagonal)
            checks.shape("diagonal", values, (min(self.shape),))
            self.known_diagonal = checks.finite("diagonal", values).astype(np.float64)

    @property
    def _keeps_norms(self) -> bool:
        """True if the norms of R are those of its core."""
        return all(W is None or W.isometric for W in (self.out, self.into))

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64: as given, else by products of at most 4096."""
        if self.known_diagonal is not None:
            return self.known_diagonal
        if self.out is None and self.into is None:
            return self.core.diagonal()
        n = min(self.shape)
        if n > MAX_DIAGONAL_PRODUCTS:
            raise InputError(
                f"the diagonal of a compressed operator of {n} pixels takes as many products; make "
                "it with diagonal=, or give first_bounce as an array (N,)"
            )
        self.known_diagonal = np.diagonal(self.to_dense()).copy()
        return self.known_diagonal

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns), by the core alone if the host has both bases."""
        if self.out is None or self.into is None or not isinstance(self.core, Dense):
            return super().between(rows, columns)
        left = self.out.columns_of(rows)
        right = self.into.columns_of(columns)
        if left is None or right is None:
            return super().between(rows, columns)
        core = self.core.matrix().astype(np.float64)
        if len(columns) <= len(rows):
            return left.T @ (core @ right)
        return (left.T @ core) @ right

    def norm_bound(self) -> NormBound:
        """Between isometric bases the bound of the core."""
        if self._keeps_norms:
            return self.core.norm_bound()
        return super().norm_bound()

    def on_coefficients(self) -> Operator:
        """The core C, where R = W^T C W in an isometric basis."""
        if self.two_sided:
            return self.core
        return super().on_coefficients()

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        first, last = (self.out, self.into) if transpose else (self.into, self.out)
        if first is None and last is None:
            return self.core._bind_product(x, out, epilogue, transpose)
        a, b, y, c = epilogue.without_shift(x)
        # Factors from right to left, with whether each is transposed.
        factors: list[tuple[Operator, bool]] = [(self.core, transpose)]
        if first is not None:
            factors.insert(0, (first, False))
        if last is not None:
            factors.append((last, True))
        *inner_factors, (last_factor, last_transposed) = factors
        operand = x
        launches = []
        for factor, is_transposed in inner_factors:
            rows = factor.shape[1] if is_transposed else factor.shape[0]
            product = self.device.empty((rows, *x.shape[1:]))
            launches.append(factor._bind_product(operand, product, PLAIN, is_transposed))
            operand = product
        added = Epilogue(a, b, y)
        launches.append(last_factor._bind_product(operand, out, added, last_transposed))
        if c:
            launches.append(vectors.bind_axpby(c, x, 1.0, out, out))
        return in_order(launches)


def _pixels(name: str, basis: Basis | None, core: Operator, coefficients: int) -> int:
    """The pixels of one side, checked to fit the core."""
    if basis is None:
        return coefficients
    if basis.shape[0] != coefficients:
        raise InputError(
            f"{name} has {basis.shape[0]} coefficients, but the core {core.shape}; it must have "
            f"{coefficients}"
        )
    if basis.device is not core.device:
        raise InputError(
            f"{name} is on another device, {basis.device}; it must be on {core.device}"
        )
    return basis.shape[1]
