# SPDX-License-Identifier: BSD-3-Clause
"""Three colour channels that see the light of each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import Epilogue

CHANNELS = 3


class Coupled(Operator):
    """picture_c = sum_j T_cj light_j, light_j = sum_i M_ji x_i, channel below channel: (3 M, 3 N).

    Parameters
    ----------
    blocks : 3 x 3 sequences of Operator (M, N) or None
        T_cj; None stands for zeros.
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

    def __init__(
        self, blocks: Sequence[Sequence[Operator | None]], mixing: np.ndarray | None = None
    ) -> None:
        present = []
        for row in blocks:
            present += [block for block in row if block is not None]
        row_lengths = [len(row) for row in blocks]
        shapes = {block.shape for block in present}
        if row_lengths != [CHANNELS] * CHANNELS or len(shapes) != 1:
            raise InputError("blocks must be 3 x 3 operators of one shape, or None")
        rows, columns = present[0].shape
        super().__init__(present[0].device, (CHANNELS * rows, CHANNELS * columns), *present)
        self.blocks = blocks
        if mixing is None:
            self.mixing = np.eye(CHANNELS)
        else:
            self.mixing = np.asarray(mixing, np.float64)
        mixing_norm = max(float(np.abs(self.mixing).sum()), 1.0)
        self.error = mixing_norm * sum(block.error for block in present)

    @classmethod
    def mixed(cls, operators: Sequence[Operator], mixing: np.ndarray) -> Coupled:
        """Channels that see only their own light, which is mixed before."""
        blocks: list[list[Operator | None]] = []
        for channel, operator in enumerate(operators):
            row: list[Operator | None] = [None] * CHANNELS
            row[channel] = operator
            blocks.append(row)
        return cls(blocks, mixing)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        width = x.shape[0] // CHANNELS
        height = out.shape[0] // CHANNELS
        light = [x.rows(channel * width, width) for channel in range(CHANNELS)]
        if not transpose:
            light = _mixed(self.mixing, light)
        sums = []
        for _ in range(CHANNELS):
            zeros = vectors.fill(self.device.empty((height, *out.shape[1:])), 0.0)
            sums.append(zeros)
        for i, j in np.ndindex(CHANNELS, CHANNELS):
            block = self.blocks[j][i] if transpose else self.blocks[i][j]
            if block is not None:
                block._queue_product(light[j], sums[i], Epilogue(a, 1.0, sums[i]), transpose)
        if transpose:
            sums = _mixed(self.mixing.T, sums)
        for channel, total in enumerate(sums):
            first = channel * height
            # y is read before `out`, which may be y, is written.
            if b and y is not None:
                vectors.axpy(b, y.rows(first, height), total)
            if c:
                vectors.axpy(c, x.rows(first, height), total)
            out.set_rows(first, total)


def _mixed(mixing: np.ndarray, light: list[Array]) -> list[Array]:
    """sum_i M_ji x_i for each j."""
    sums = []
    for weights in mixing:
        total = vectors.axpby(weights[0], light[0], weights[1], light[1], light[0].like())
        sums.append(total)
    for weights, total in zip(mixing, sums, strict=True):
        vectors.axpy(weights[2], light[2], total)
    return sums
