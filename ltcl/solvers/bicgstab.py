# SPDX-License-Identifier: BSD-3-Clause
"""BiCGStab: any S, two products a step, eight vectors of memory however many steps it takes.

It asks for no bounds and no symmetry, but promises nothing: residuals swing, and a step may not exist (a
division by 0). Such a column starts anew from where it is; where even a fresh start has no step it rests for
good. Each right-hand side has coefficients of its own and rests once it is solved.

A step is five launches: since <r*, S p> = <g, p> with g = S^T r*, one product for all steps, the first
coefficient is known before S p is. Where S has no transpose a sixth finds it. Coefficients stay on the
device, and several steps are queued between two readings of the residuals.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 7.7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl.device import Array, vectors
from ltcl.device.kernels import Launch
from ltcl.errors import InputError, MemoryLimitError
from ltcl.solvers.columns import STATE, Columns
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_STEP = 3  # argument of both updates
_TWO = 0b0101_0001  # <a, b> and <b, b>, of arrays a, b; the left operand in the lower bits
_FIVE = 0b0101_0010_0110_0000_0100  # <t, s>, <t, t>, <r*, s>, <r*, t> and <s, s>, of arrays t, s, r*
_RHO, _DOES, _SHADOW, _AGAINST = (0, 4), (1, 5), 9, 10  # rows of the state; two of even and of odd steps
_FRESH, _WAITS, _BROKEN, _RESTS = 1.0, 2.0, 3.0, 4.0


@dataclass(frozen=True)
class BiCGStab:
    """No options."""

    name: ClassVar[str] = "bicgstab"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        S, columns = system.S, Columns(r, "krylov", "krylov_pairs", "krylov_half", "krylov_bicgstab")
        shadow, p, g, v, half, t = (r.like() for _ in range(6))
        state, two, five, slices = columns.state(), columns.sums(2), columns.sums(5), columns.slices
        of_g = columns.bind("krylov_pairs", _TWO, 0, r, g, p, p, two, across=2)
        of_v = columns.bind("krylov_pairs", _TWO, 0, r, shadow, v, v, two, across=2)
        of_t = columns.bind("krylov_pairs", _FIVE, 0, r, t, half, shadow, five, across=5)
        to_half = columns.bind("krylov_half", slices, 0, two, state, r, v, half, extra=2)
        moves = (slices, 0, five, state, two, g, half, t, v, p, x, r)
        to_next = columns.bind("krylov_bicgstab", *moves, extra=5)
        queued = [S.bind(p, v), to_half, S.bind(half, t), of_t, to_next]  # 4. to 9.
        numbers, does, step, transposes = np.zeros((STATE, r.columns)), np.full(r.columns, _WAITS), 0, True
        while True:
            anew = monitor.unsolved & ((does == _WAITS) | (does == _RESTS))
            changed, now = numbers.copy(), step % 2
            rests = ~monitor.unsolved & (does != _BROKEN)
            changed[_DOES[now]] = np.where(anew, _FRESH, np.where(rests, _RESTS, does))
            if anew.any():
                _start_anew((shadow, p), r, anew if step else None)  # 1., 2.
                for row in (_RHO[now], _SHADOW):
                    changed[row] = np.where(anew, monitor.norms**2, changed[row])
                changed[_AGAINST] = changed[_SHADOW]
                squares = _squares_of_g(system, shadow, g) if transposes else None
                if squares is not None:
                    changed[_AGAINST] = squares
                elif transposes:
                    transposes = False
                    queued.insert(1, of_v)
            if not np.array_equal(changed, numbers):
                state.set_rows(0, r.device.upload(changed))
            if anew.any() and transposes:
                of_g()
            steps = range(step, step + monitor.steps_ahead())
            _queue(queued, (to_half, to_next), steps)
            system.products += 2 * len(steps)
            step = steps.stop
            numbers, norms = columns.read(state, steps.start, step)
            does = numbers[_DOES[step % 2]]
            if monitor.check(x, r, norms, np.inf):
                return
            if (does == _BROKEN).any() and (does[monitor.unsolved] == _BROKEN).all():
                monitor.status = Status.NO_STEP
                return
            if not np.array_equal(monitor.norms, norms[-1]):  # r is the true residual now, p is not of it
                does = np.where(does == _BROKEN, does, _WAITS)


def _start_anew(vectors: Sequence[Array], r: Array, columns: np.ndarray | None) -> None:
    """r* = p = r in these columns, (k,) bool, or in all."""
    for vector in vectors:
        if columns is None:
            vector.copy_from(r)
        else:
            vector.set(np.where(columns, r.get(), vector.get()))


def _queue(launches: Sequence[Callable[[], object]], updates: Sequence[Launch], steps: range) -> None:
    for step in steps:
        for update in updates:
            update.set(_STEP, step)
        for launch in launches:
            launch()


def _squares_of_g(system: System, shadow: Array, g: Array) -> np.ndarray | None:
    """The squared norms of g = S^T r*; None where S has no transpose, or no memory for it."""
    try:
        system.S.apply_transpose(shadow, g)
    except (InputError, MemoryLimitError):
        return None
    system.products += 1
    return vectors.dot(g, g)
