# SPDX-License-Identifier: BSD-3-Clause
"""Three colour channels that see the light of each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Epilogue, Operator


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
