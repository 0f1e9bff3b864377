# SPDX-License-Identifier: BSD-3-Clause
"""Arnoldi's method: an orthonormal basis v_0, v_1, ... of what products with S reach, S V = V H.

Each step is a product and classical Gram-Schmidt, twice, which is enough for orthogonality to rounding
(Giraud, Langou, Rozloznik, Comput. Math. Appl. 50, 2005): five launches and one wait, for a column of H.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 6.2 in blocks.
"""

from __future__ import annotations

import numpy as np

from ltcl.device import Array
from ltcl.operators import Operator
from ltcl.solvers.columns import Columns

_COUNT = 2  # argument of krylov_subtract


class Arnoldi:
    """The space of S and a start (N, k), one for each column.

    Attributes
    ----------
    V : Array, (steps + 1, N k)
        v_0 .. v_count, each a row.
    count : int
        Steps made.
    steps : int
        That there is room for: those asked for, or less where these are thousands.
    """

    def __init__(self, S: Operator, start: Array, steps: int) -> None:
        device, self.count = start.device, -1
        self._columns = columns = Columns(start, "krylov", "krylov_dots", "krylov_subtract")
        self.steps = min(steps, columns.room - 3)  # whose coefficients a work-group holds
        rows = self.steps + 1
        device.require(
            rows * start.nbytes, f"restart={steps}, {rows} directions of {start.size} values each,"
        )
        self.V = device.empty((rows, start.size))
        v, w = start.like(), start.copy()
        sums, self._h = columns.sums(rows + 1), [device.empty((rows + 1, columns.k)) for _ in range(2)]
        self._product = S.bind(v, w)
        self._dots = columns.bind("krylov_dots", self.V, w, sums)
        self._subtract = [
            columns.bind(
                *("krylov_subtract", 0, columns.slices, again, again, sums, self._h[0], h, self.V, w, out),
                extra=rows + 2,
            )
            for again, h, out in ((0, self._h[0], w), (1, self._h[1], v))
        ]
        self._orthogonalize()

    def extend(self) -> np.ndarray:
        """One step: the next direction, and the new columns of H.

        Returns
        -------
        (k, count + 1) float64
            h_1j .. h_(j+1)j. Where S v_j lies in the space but for rounding the last is 0, and so is v_(j+1).
        """
        self._product()  # 3.
        self._orthogonalize()
        return self._h[1].get()[: self.count + 1].T.astype(np.float64)

    def add_to(self, x: Array, y: np.ndarray) -> None:
        """x = x + sum_j y_j v_j with y (k, j)."""
        count = y.shape[1]
        minus_y = x.device.upload(np.pad(-y.T, ((0, 1), (0, 0))))  # as sums of one slice, <w, w> among them
        arguments = (count, 1, 0, 0, minus_y, *self._h, self.V, x, x)
        self._columns.bind("krylov_subtract", *arguments, extra=count + 2)()

    def _orthogonalize(self) -> None:
        """What a product left becomes the next direction."""
        self.count += 1
        self._dots.resize(self._columns.items(self.count + 1))
        for subtract in self._subtract[0 if self.count else 1 :]:
            self._dots()  # 4.
            subtract.set(_COUNT, self.count)
            subtract()  # 5. to 8.
