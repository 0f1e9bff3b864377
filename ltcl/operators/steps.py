# SPDX-License-Identifier: BSD-3-Clause
"""Steps of Southwell's relaxation on S = shift I + scale M, by `kernels/southwell.cl`.

A step relaxes one row of each part of the picture, the one with the largest residual, and keeps the residual
up to date by the columns of S: those rows' share of a product.
"""

from __future__ import annotations

import numpy as np

from ltcl.device import Array
from ltcl.operators.base import Operator
from ltcl.operators.csr import CSR
from ltcl.operators.relaxation import readable, refuse_zeros

_STRETCHES = 64  # pieces of the residual that are brought up to date side by side on a CPU
_STRETCH = 64  # rows of such a piece on a GPU


class Steps:
    """Steps of S on an iterate `x` and its residual `r`, each (N,) or (N, k), with `parts` rows a step.

    Raises
    ------
    InputError
        S does not give its rows, or has a zero on its diagonal; the message names `method`.
    """

    def __init__(self, S: Operator, method: str, x: Array, r: Array, parts: int) -> None:
        self.rows, self.x, self.r, self.parts = readable(S, method), x, r, parts
        self.device, k = S.device, x.columns
        diagonal = self.rows.shift + self.rows.scale * self.rows.M.diagonal()
        refuse_zeros(diagonal, method)
        self._inverse = self.device.upload(1.0 / diagonal)
        self._picked, self._delta = self.device.empty((parts, k), np.int32), self.device.empty((parts, k))
        n = x.shape[0]
        self._size = max(1, -(-n // _STRETCHES)) if self.device.is_cpu else _STRETCH

    def step(self) -> None:
        """Queue one step."""
        k, n = self.x.columns, self.x.shape[0]
        picks = (n, self.parts, k, self.rows.shift, self._inverse, self.x, self.r, self._picked, self._delta)
        self.device.kernel("southwell", "southwell_pick")((self.parts, k), (1, 1), *picks)
        if isinstance(self.rows.M, CSR):
            self._sparse_columns(self.rows.M.transposed_copy(), k)
        else:
            self._dense_columns(k)

    def _sparse_columns(self, transposed: CSR, k: int) -> None:
        kernel = self.device.kernel("southwell", "southwell_csr")
        stretches = -(-self.x.shape[0] // self._size)
        for slab in transposed.slabs:
            place = (stretches, self._size, slab.rows, slab.first, self.parts, k, self.rows.scale)
            kernel((stretches, k), (1, 1), *place, *slab.arguments, self._picked, self._delta, self.r)

    def _dense_columns(self, k: int) -> None:
        kernel = self.device.kernel("southwell", "southwell_dense")
        for slab in self.rows.M.slabs:
            place = (slab.rows, slab.first, self.parts, k, self.rows.scale)
            kernel((slab.rows, k), (64, 1), *place, *slab.arguments, self._picked, self._delta, self.r)
