# SPDX-License-Identifier: BSD-3-Clause
"""Products with a matrix that is read anew for each: what no memory holds can still be measured against."""

from __future__ import annotations

import numpy as np

from ltcl.compression.sources import RowSource, at_once, cut
from ltcl.device import Array, Device
from ltcl.operators import Operator


class Streamed(Operator):
    """An operator whose rows come from a source, block by block, at every product.

    Parameters
    ----------
    device : Device
        Where operands live; the products are made by the host, which has the rows at hand.
    matrix : RowSource, (M, N)
    memory : int, optional
        Bytes for a block; as `sources.at_once`.
    """

    def __init__(self, device: Device, matrix: RowSource, memory: int | None = None) -> None:
        super().__init__(device, matrix.shape)
        self.matrix, self.memory = matrix, memory

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64: one reading of the rows."""
        found = np.zeros(min(self.shape))
        for start, rows in self._blocks(np.float64):  # not rounded: a first bounce may be made of it
            here = np.diagonal(rows, start)
            found[start : start + len(here)] = here
        return found

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        host = x.get().reshape(x.shape[0], -1)
        product = np.zeros((out.shape[0], host.shape[1]))
        for start, rows in self._blocks():
            if transpose:
                product += rows.T @ host[start : start + len(rows)]
            else:
                product[start : start + len(rows)] = rows @ host
        product = scale * product.reshape(out.shape)
        out.set(product if add is None else product + add.get())

    def _blocks(self, dtype: type = np.float32):
        for start, stop in cut(self.shape[0], at_once(self.shape[1], self.memory)):
            yield start, np.asarray(self.matrix.rows(start, stop), dtype)
