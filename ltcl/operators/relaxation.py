# SPDX-License-Identifier: BSD-3-Clause
"""Sweeps over the rows of S = shift I + scale M, block after block, by `kernels/relax.cl`.

Gauss-Seidel and SOR are a forward substitution, x += (D / omega + L)^-1 (b - S x): of each block a parallel
product with the x of the moment, then the small triangle inside it. Their blocks are a matter of speed: the
iterates are those of the textbook, up to rounding. Block Gauss-Seidel solves with all of S_BB in place of the
triangle, and its iterates change with the blocks.

Sparse triangles are solved in place and in sequence, which takes two launches a block. Where blocks have
inverses, small ones, one launch corrects a block and runs the product for the next, which leaves out what the
first changes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators import blocks
from ltcl.operators.base import Operator, widths
from ltcl.operators.blocks import Block, Finish, Rows
from ltcl.operators.composed import IdentityPlus
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense

_ITEMS = 8  # rows of a work-group on a CPU: few, so that cores end a block together
_CORRECTED = 256  # rows of a work-group that only corrects them


class Sweep:
    """What one solve keeps from sweep to sweep; all of the shape of the iterate.

    `x` is the iterate, `before` the one before it and `r` the residual of that. `s` is the right-hand side of
    a block, `delta` its correction, `carry` what the next residual is made of.
    """

    def __init__(self, x: Array, b: Array, r: Array) -> None:
        self.x, self.b, self.r = x, b, r
        self.before, self.s, self.delta, self.carry = x.like(), x.like(), x.like(), x.like()


@dataclass(frozen=True)
class Step:
    """One launch: the product for rows begin .. begin + rows of a slab, beside what finishes a block."""

    slab: int
    begin: int
    rows: int
    start: int  # columns of the product below it are those of the new iterate
    finish: Finish


class Relaxation:
    """The sweeps of one operator with one block size; made by `relaxation`, which keeps it.

    Parameters
    ----------
    rows : Rows
    finishes : list of Finish
        One for each block of rows, in order; all in sequence or all by inverse.
    omega : float
        Stretches corrections that are made in sequence; those by inverse contain it.
    """

    def __init__(self, rows: Rows, finishes: list[Finish], omega: float) -> None:
        self.rows, self.omega = rows, omega
        self.device: Device = rows.M.device
        self.block = max((f.block.stop - f.block.start for f in finishes), default=1)
        self.in_place = any(finish.chained >= 0 for finish in finishes)
        self._slabs = self._arguments(finishes)
        self._steps = list(self._plan(finishes))

    def sweep(self, state: Sweep) -> None:
        """Queue one sweep: `x` becomes the next iterate, `r` the residual of the one before.

        The residual holds from the second sweep of a `state` on.
        """
        if self.in_place:
            state.before.copy_from(state.x)
        else:
            state.x, state.before = state.before, state.x
        for offset, width in widths(state.x.columns):
            launch = self._launch(state, offset, width)
            for step in self._steps:
                launch(step)

    def _launch(self, state: Sweep, offset: int, width: int) -> Callable[[Step], None]:
        """What queues a step for `width` right-hand sides from `offset` on."""
        rows, columns = self.rows, state.x.columns
        fastest = rows.M.fastest(state.x, width)  # variants of one name read rows alike
        variant = fastest.kernel.name.removeprefix(f"{rows.M.file}_matvec")
        packed = {"PACKED": 1} if width == columns else {}
        kernel = self.device.kernel("relax", f"relax_{rows.M.file}{variant}", K=width, **packed)
        group = fastest.group or (_ITEMS if self.device.is_cpu else 64)
        taken = 1 if fastest.group else group  # rows of a work-group
        numbers = (columns, offset, rows.shift, rows.scale)
        old = state.x if self.in_place else state.before
        vectors = (old, state.x, state.b, state.s, state.delta, state.r, state.carry)
        local = (self.device.local(group),) if fastest.group else ()
        alone = self.device.kernel("relax", "relax_substitute", K=width, **packed)

        def launch(step: Step) -> None:
            block, finish = step.finish.block, step.finish
            count = block.stop - block.start
            if finish.chained >= 0:
                size = min(_CORRECTED, self.device.max_group)
                items = size * (1 - (finish.chained - count) // size)
                numbered = (count, finish.chained, columns, offset, self.omega)
                alone(items, size, *numbered, *finish.arguments, state.x, state.s)
                return
            lead, work = -(-count // taken), -(-step.rows // taken)
            place = (
                step.rows,
                step.begin,
                rows.M.slabs[step.slab].first,
                lead,
                step.start,
                count,
                block.before,
            )
            arguments = (*place, *numbers, *self._slabs[step.slab], *finish.arguments, *vectors)
            kernel(group * (lead + work), group, *arguments, *local)

        return launch

    def _arguments(self, finishes: list[Finish]) -> list[tuple[Any, ...]]:
        """What the kernels take for each slab."""
        M = self.rows.M
        if isinstance(M, Dense):
            return [slab.arguments for slab in M.slabs]
        counts, found = blocks.middle(M, [finish.block for finish in finishes]), []
        for slab in M.slabs:
            pointers = M.pattern.indptr[slab.first : slab.first + slab.rows]
            within = pointers - (pointers[0] if slab.rows else 0)
            split = within + counts[slab.first : slab.first + slab.rows]
            found.append((*slab.arguments, self.device.upload(split, np.int32)))
        return found

    def _plan(self, finishes: list[Finish]) -> Iterator[Step]:
        """Blocks are those of the matrix: one that crosses slabs has its product in several launches."""
        waiting = nothing = Finish(Block(0, 0, 0), -1, (self.device.upload([0.0]),))
        for finish in finishes:
            for number, slab in enumerate(self.rows.M.slabs):
                begin = max(finish.block.start, slab.first)
                stop = min(finish.block.stop, slab.first + slab.rows)
                if begin < stop:
                    yield Step(number, begin - slab.first, stop - begin, finish.block.before, waiting)
                    waiting = nothing
            waiting = finish
            if self.in_place:
                yield Step(0, 0, 0, finish.block.start, finish)
                waiting = nothing
        if not self.in_place:
            yield Step(0, 0, 0, waiting.block.start, waiting)


def relaxation(S: Operator, method: str, block: int | None = None, omega: float = 1.0) -> Relaxation:
    """The sweeps of Gauss-Seidel and SOR, made at the first call and kept with the matrix of S.

    Raises
    ------
    InputError
        S does not give its rows, or has a zero on its diagonal; the message names `method`.
    MemoryLimitError
        More than the device holds; said before anything is computed.
    """
    rows = readable(S, method)

    def finishes() -> list[Finish]:
        refuse_zeros(rows.diagonal(), method)
        # In sequence is slow on a GPU, and a dense triangle is no smaller than its inverse.
        sequential = rows.M.device.is_cpu and isinstance(rows.M, CSR)
        size = block or blocks.best_size(rows.M, sequential=sequential)
        cut = blocks.cut(S.shape[0], size, overlap=not sequential)
        if sequential:
            return list(blocks.in_sequence(rows, cut))
        return list(blocks.by_inverse(rows, cut, omega, method))

    return _kept(rows, ("triangle", block), omega, finishes)


def block_relaxation(S: Operator, method: str, block: int) -> Relaxation:
    """The sweeps of block Gauss-Seidel with `block` rows a block, kept likewise.

    Raises
    ------
    InputError
        S does not give its rows, or a block has no inverse; the message names `method`.
    MemoryLimitError
        More than the device holds; said before anything is computed.
    """
    rows = readable(S, method)

    def finishes() -> list[Finish]:
        return list(blocks.by_inverse(rows, blocks.cut(S.shape[0], block, overlap=True), None, method))

    return _kept(rows, ("block", block), 1.0, finishes)


def _kept(
    rows: Rows, kind: tuple[str, int | None], omega: float, finishes: Callable[[], list[Finish]]
) -> Relaxation:
    """One for each kind: that of another omega takes the place of the one before."""
    kept, key = rows.M.relaxations, (rows.shift, rows.scale, *kind)
    if key not in kept or kept[key].omega != omega:
        kept.pop(key, None)
        kept[key] = Relaxation(rows, finishes(), omega)
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
