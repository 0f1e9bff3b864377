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

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl.device import Array, vectors
from ltcl.errors import InputError, MemoryLimitError
from ltcl.solvers.columns import STATE, Columns
from ltcl.solvers.result import Status
from ltcl.solvers.stopping import Monitor, System

_STEP = 3  # argument of both updates
_TWO = 0b0101_0001  # <a, b> and <b, b>, of arrays a, b; the left operand in the lower bits
_FIVE = 0b0101_0010_0110_0000_0100  # <t, s>, <t, t>, <r*, s>, <r*, t> and <s, s>, of arrays t, s, r*
_RHO, _DOES, _SHADOW, _AGAINST = (0, 4), (1, 5), 9, 10  # rows of the state; two of even and of odd steps
_GOES, _FRESH, _WAITS, _BROKEN, _RESTS = range(5)


@dataclass(frozen=True)
class BiCGStab:
    """No options."""

    name: ClassVar[str] = "bicgstab"

    def iterate(self, system: System, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends it."""
        if monitor.check(x, r):
            return
        run = _Recurrences(system, x, r)
        does = np.full(r.columns, float(_WAITS))
        while True:
            run.start(does, monitor)
            for _ in range(monitor.steps_ahead()):
                run.step()
            does, norms = run.read()
            if monitor.check(x, r, norms, recursive=True):
                return
            if (does == _BROKEN).any() and (does[monitor.unsolved] == _BROKEN).all():
                monitor.give_up(Status.NO_STEP)
                return
            if not np.array_equal(monitor.norms, norms[-1]):  # r is the true residual now, p is not of it
                does = np.where(does == _BROKEN, does, _WAITS)


class _Recurrences:
    """The vectors of the method, and what one step leaves to the next."""

    def __init__(self, system: System, x: Array, r: Array) -> None:
        self._system, self._r = system, r
        self._shadow, self._p = r.copy(), r.copy()
        self._g, v, half, t = (r.like() for _ in range(4))
        self._columns = columns = Columns(r, "krylov", "krylov_pairs", "krylov_half", "krylov_bicgstab")
        self._state, two, five = columns.state(), columns.sums(2), columns.sums(5)
        self._numbers, self._transposes = np.zeros((STATE, r.columns)), True
        self._steps = self._first = 0
        state, slices, shadow, p, g = self._state, columns.slices, self._shadow, self._p, self._g
        to_half, to_next = (slices, 0, two, state, r, v, half), (slices, 0, five, state, two)
        self._of_g, self._of_v, products = (
            columns.bind("krylov_pairs", codes, 0, r, *arrays, sums, across=count)
            for codes, arrays, sums, count in (
                (_TWO, (g, p, p), two, 2),
                (_TWO, (shadow, v, v), two, 2),
                (_FIVE, (t, half, shadow), five, 5),
            )
        )
        self._updates = [
            columns.bind("krylov_half", *to_half, extra=2),
            columns.bind("krylov_bicgstab", *to_next, g, half, t, v, p, x, r, extra=5),
        ]
        S, (half_step, next_step) = system.S, self._updates
        self._queued = [S.bind(p, v), half_step, S.bind(half, t), products, next_step]  # 4. to 9.

    def start(self, does: np.ndarray, monitor: Monitor) -> None:
        """Start the unsolved columns that wait for it anew, with r* = p = r; those that are solved rest."""
        anew = monitor.unsolved & ((does == _WAITS) | (does == _RESTS))
        does = np.where(anew, _FRESH, np.where(monitor.unsolved | (does == _BROKEN), does, _RESTS))
        numbers, now = self._numbers.copy(), self._steps % 2
        numbers[_DOES[now]] = does
        if anew.any():
            for vector in (self._shadow, self._p):
                vectors.axpby_columns(anew, self._r, ~anew, vector, vector)  # 1., 2.
            numbers[_RHO[now]] = np.where(anew, monitor.norms**2, numbers[_RHO[now]])
            numbers[_SHADOW] = np.where(anew, monitor.norms**2, numbers[_SHADOW])
            numbers[_AGAINST] = self._squares_of_g() if self._transposes else numbers[_SHADOW]
        if not np.array_equal(numbers, self._numbers):
            self._state.set_rows(0, self._r.device.upload(numbers))
        if anew.any() and self._transposes:
            self._of_g()

    def _squares_of_g(self) -> np.ndarray:
        """The squared norms of g = S^T r*; those of r* where S has no transpose, or no memory for it."""
        try:
            self._system.S.apply_transpose(self._shadow, self._g)
        except (InputError, MemoryLimitError):
            self._transposes = False
            self._queued.insert(1, self._of_v)
            return vectors.dot(self._shadow, self._shadow)
        self._system.products += 1
        return vectors.dot(self._g, self._g)

    def step(self) -> None:
        """One step of all columns that do not rest."""
        for update in self._updates:
            update.set(_STEP, self._steps)
        for launch in self._queued:
            launch()
        self._steps += 1
        self._system.products += 2

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """What each column does, and the norms of the residuals since the last reading; the wait."""
        self._numbers, norms = self._columns.read(self._state, self._first, self._steps)
        self._first = self._steps
        return self._numbers[_DOES[self._steps % 2]], norms
