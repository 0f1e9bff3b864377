# SPDX-License-Identifier: BSD-3-Clause
"""Three colour channels as one operator, where the light of one is seen in another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Operator

_COLOURS = range(3)


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
        found = [block for row in blocks for block in row if block is not None]
        if [len(row) for row in blocks] != [3, 3, 3] or len({block.shape for block in found}) != 1:
            raise InputError("blocks must be 3 x 3 operators of one shape, or None")
        rows, columns = found[0].shape
        super().__init__(found[0].device, (3 * rows, 3 * columns))
        self.blocks = [list(row) for row in blocks]
        self.mixing = np.eye(3) if mixing is None else np.asarray(mixing, np.float64)
        self.error = max(float(np.abs(self.mixing).sum()), 1.0) * sum(block.error for block in found)

    @classmethod
    def mixed(cls, operators: Sequence[Operator], mixing: np.ndarray) -> Coupled:
        """Channels that see only their own light, which is mixed before."""
        return cls([[T if c == j else None for j in _COLOURS] for c, T in enumerate(operators)], mixing)

    @property
    def nbytes(self) -> int:
        """Bytes of all blocks."""
        return sum(block.nbytes for row in self.blocks for block in row if block is not None)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (3 N,) float64, of square blocks."""
        if self.shape[0] != self.shape[1]:
            raise InputError(f"the blocks of a {self.shape} operator are not square; it has no diagonal")
        zero = np.zeros(self.shape[0] // 3)
        parts = [[zero if block is None else block.diagonal() for block in row] for row in self.blocks]
        return np.concatenate([self.mixing[:, c] @ np.stack(parts[c]) for c in _COLOURS])

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        parts = [x.rows(c * x.shape[0] // 3, x.shape[0] // 3) for c in _COLOURS]
        parts = parts if transpose else _mixed(self.mixing, parts)
        height = out.shape[0] // 3
        sums = [vectors.fill(self.device.empty((height, *out.shape[1:])), 0.0) for _ in _COLOURS]
        for c in _COLOURS:
            for j in _COLOURS:
                block, (to, of) = self.blocks[c][j], (j, c) if transpose else (c, j)
                if block is not None:
                    block._product(parts[of], sums[to], scale, sums[to], transpose)
        for c, part in enumerate(_mixed(self.mixing.T, sums) if transpose else sums):
            if add is not None:  # read before `out`, which may be the same, is written
                vectors.axpy(1.0, add.rows(c * height, height), part)
            out.set_rows(c * height, part)


def _mixed(M: np.ndarray, parts: list[Array]) -> list[Array]:
    """sum_i M_ji x_i for each j."""
    mixed = []
    for row in M:
        out = vectors.axpby(row[0], parts[0], row[1], parts[1], parts[0].like())
        mixed.append(vectors.axpy(row[2], parts[2], out))
    return mixed
