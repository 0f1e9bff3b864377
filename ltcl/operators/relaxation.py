# SPDX-License-Identifier: BSD-3-Clause
"""Sweeps of Gauss-Seidel and SOR over the rows of S = shift I + scale M, by `kernels/relax.cl`.

A sweep is a forward substitution, x += (D / omega + L)^-1 (b - S x), in blocks of rows: of each block a
parallel product with the x of the moment, then the small triangle inside it in sequence. The blocks are a
matter of speed: whatever their size, the iterates are those of the textbook, up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators import triangles
from ltcl.operators.base import Operator, widths
from ltcl.operators.composed import IdentityPlus
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.rows import Slab

_ITEMS = 8  # rows of a work-group on a CPU: few, so that cores end a block together


@dataclass(frozen=True)
class Rows:
    """S = shift I + scale M, where M has rows to read."""

    M: CSR | Dense
    shift: float
    scale: float


@dataclass(frozen=True)
class Part:
    """A slab of M with what a sweep needs beside it: its arguments in the two launches of a block."""

    slab: Slab
    product: tuple[Any, ...]
    triangle: tuple[Any, ...]


@dataclass
class Sweep:
    """What one solve keeps from sweep to sweep; all of the shape of the iterate.

    `s` is the right-hand side of a block and then its correction, `carry` what the next residual is made of.
    """

    x: Array
    b: Array
    s: Array
    r: Array
    carry: Array


class Relaxation:
    """The sweeps of one operator with one block size; made by `relaxation`, which keeps it.

    Parameters
    ----------
    rows : Rows
    block : int, optional
        Rows of a block; chosen for the device and the matrix when not given.
    """

    def __init__(self, rows: Rows, block: int | None) -> None:
        self.rows = rows
        self.device: Device = rows.M.device
        self.block = triangles.best_block(rows.M) if block is None else min(block, max(rows.M.shape[0], 1))
        self.diagonal = rows.shift + rows.scale * rows.M.diagonal()
        self._inverses: dict[float, Array] = {}
        self._parts = [self._part(slab) for slab in rows.M.slabs]

    def sweep(self, state: Sweep, omega: float) -> None:
        """Queue one sweep: `x` becomes the next iterate, `r` the residual of the one before.

        The residual holds from the second sweep of a `state` on.
        """
        for offset, width in widths(state.x.columns):
            for part in self._parts:
                for begin in range(0, part.slab.rows, self.block):
                    rows = min(self.block, part.slab.rows - begin)
                    place = (rows, begin, part.slab.first, state.x.columns, offset)
                    self._product(part, place, width, state)
                    self._substitute(part, place, width, state, omega)

    def _product(self, part: Part, place: tuple[int, ...], width: int, state: Sweep) -> None:
        """s_B = b_B - (S x)_B."""
        arguments = (
            *place,
            self.rows.shift,
            self.rows.scale,
            *part.product,
            state.x,
            state.b,
            state.s,
            state.r,
            state.carry,
        )
        fastest = self.rows.M.fastest(state.x, width)  # variants of one name read rows alike
        variant = fastest.kernel.name.removeprefix(f"{self.rows.M.file}_matvec")
        kernel = self._kernel(f"relax_{self.rows.M.file}{variant}", width, state.x.columns)
        if fastest.group:
            local = self.device.local(fastest.group)
            kernel(place[0] * fastest.group, fastest.group, *arguments, local)
        else:
            kernel(place[0], _ITEMS if self.device.is_cpu else 64, *arguments)

    def _substitute(self, part: Part, place: tuple[int, ...], width: int, state: Sweep, omega: float) -> None:
        """(D / omega + L)_BB delta = s_B, x_B += delta."""
        kernel = self._kernel(f"relax_{self.rows.M.file}_triangle", width, state.x.columns)
        inverse = self._inverse(omega)
        kernel(1, 1, *place, omega, *part.triangle, inverse, state.x, state.s, state.carry)

    def _kernel(self, name: str, width: int, columns: int) -> Any:
        packed = {"PACKED": 1} if width == columns else {}
        return self.device.kernel("relax", name, K=width, **packed)

    def _inverse(self, omega: float) -> Array:
        if omega not in self._inverses:
            self._inverses[omega] = self.device.upload(omega / self.diagonal)
        return self._inverses[omega]

    def _part(self, slab: Slab) -> Part:
        if isinstance(self.rows.M, Dense):
            return Part(slab, slab.arguments, (self.rows.scale, *slab.arguments))
        middle, inside = triangles.split(self.rows.M, slab, self.block, self.rows.scale)
        return Part(slab, (*slab.arguments, middle), inside)


def relaxation(S: Operator, method: str, block: int | None = None) -> Relaxation:
    """The sweeps of S, made at the first call and kept with its matrix.

    Raises
    ------
    InputError
        S does not give its rows, or has a zero on its diagonal; the message names `method`.
    """
    rows = readable(S, method)
    kept, key = rows.M.relaxations, (rows.shift, rows.scale, block)
    if key not in kept:
        made = Relaxation(rows, block)
        refuse_zeros(made.diagonal, method)
        kept[key] = made
    return kept[key]


def readable(S: Operator, method: str) -> Rows:
    """The rows of S; operators that do not give them are refused, naming `method`."""
    shift, scale, M = (1.0, S.sign, S.R) if isinstance(S, IdentityPlus) else (0.0, 1.0, S)
    if not isinstance(M, CSR | Dense):
        raise InputError(
            f"method={method!r} reads S row by row, which {type(M).__name__} does not allow; give a dense or "
            "sparse matrix, or use method='chebyshev'"
        )
    return Rows(M, shift, scale)


def refuse_zeros(diagonal: np.ndarray, method: str) -> None:
    """Refuse to divide by a zero on the diagonal of S, naming its first row and `method`."""
    zeros = np.flatnonzero(diagonal.astype(np.float32) == 0.0)
    if zeros.size:
        raise InputError(
            f"method={method!r} divides by the diagonal of S, which is 0 in {zeros.size} row(s), "
            f"first in row {zeros[0]}; use method='direct'"
        )
