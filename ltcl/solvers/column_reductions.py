# SPDX-License-Identifier: BSD-3-Clause
"""Sums over each column of (N, k) arrays, between two products, that stay on the device.

A kernel leaves partial sums of each column in a few slices of the rows
(`kernels/common/columns.h`); a group of the next kernel adds them up and computes the coefficients
of its columns. So several steps can be queued between two readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Array, vectors
from ltcl.device.kernels import Kernel, Launch
from ltcl.operators import Operator
from ltcl.operators.shared_vector import SharedVector, Vector
from ltcl.solvers import krylov_state
from ltcl.solvers.krylov_state import STATE_ROWS
from ltcl.solvers.shared_columns import SharedColumns
from ltcl.solvers.stopping import SLOTS

# Values that an item should have before there are more groups.
VALUES_PER_ITEM = 32

# Most slices, of which each has a group.
MAX_SLICES = 256

# Defines of the kernels in a file, beside those of `common/columns.h`.
DEFINES = {"krylov": krylov_state.DEFINES}


def safe_ratio(numerator: np.ndarray, denominator: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return numerator / denominator in the columns `where` a step is taken, and 0 in the others.

    A denominator beyond float32 gives NaN, not a step of 0 that would be repeated for ever.
    """
    # The monitor sees what comes of a division by zero.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        finite = np.where(np.isfinite(denominator), denominator, np.nan)
        return np.where(where, numerator / finite, 0.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class StepReadings:
    """Numbers of the state after some steps, (STATE_ROWS, k), and residual norms, (steps, k)."""

    state: np.ndarray
    norms: np.ndarray


class ColumnReductions:
    """Kernels of files that include `common/columns.h`, for arrays like `x`, (N,) or (N, k).

    With several planes x is (planes N, 1), and each plane of N rows counts as a column.
    """

    def __init__(self, x: Array, *kernels: str, planes: int = 1) -> None:
        self.device = x.device
        self.k = x.columns * planes
        self.rows = x.shape[0] // planes
        of_planes = {}
        if planes > 1:
            of_planes["PLANES"] = 1
        self._kernels: dict[str, Kernel] = {}
        for name in kernels:
            file = name.partition("_")[0]
            defines = DEFINES.get(file, {}) | of_planes
            self._kernels[name] = vectors.kernel_of(self.device, name, **defines)
        if self.device.is_cpu:
            items = 16 if self.k <= 16 else 64
            max_slices = min(4 * self.device.compute_units, MAX_SLICES)
        else:
            items = 256
            max_slices = MAX_SLICES
        self.group = min(kernel.group(items) for kernel in self._kernels.values())
        enough = -(-x.size // (VALUES_PER_ITEM * self.group))
        self.slices = max(1, min(enough, max_slices))

    def bind(self, name: str, /, *, extra: int = 0, across: int = 1, **arguments: object) -> Launch:
        """Bind kernel `name`, `across` times, with local memory for `extra` reals a column.

        `rows`, `k` and `scratch` are those of `x` when not given.
        """
        scratch = self.device.local(self.group + extra * min(self.k, self.group))
        shared = {"rows": self.rows, "k": self.k, "scratch": scratch}
        return self._kernels[name].bind(
            self.items(across), (self.group, 1, 1), **(shared | arguments)
        )

    def bind_product(self, S: Operator, x: Array, out: Array) -> Callable[[], object]:
        """Bind out = S x."""
        return S.bind(x, out)

    def apply_transpose(self, S: Operator, x: Array, out: Array) -> np.ndarray:
        """Compute out = S^T x; return the squares (k,) of the norms of its columns."""
        S.apply_transpose(x, out)
        return vectors.dot(out, out)

    @property
    def max_totals(self) -> int:
        """Most totals of a column that a work-group holds."""
        room = self.device.local_memory // 4 - self.group
        return room // min(self.k, self.group)

    def resize(self, dots: Launch, across: int) -> None:
        """Change how many inner products a launch makes."""
        dots.resize(self.items(across))

    def items(self, across: int) -> tuple[int, int, int]:
        """Return the work-items of a launch, `across` times."""
        groups_of_columns = -(-self.k // self.group)
        return self.slices * self.group, across, groups_of_columns

    def sums(self, count: int) -> Array:
        """Allocate room for `count` partial sums of each column."""
        return self.device.empty((self.slices * count, self.k))

    def numbers(self, rows: int) -> Array:
        """Allocate rows of a number for each column."""
        return self.device.empty((rows, self.k))

    def upload(self, values: np.ndarray, dtype: Any = np.float32) -> Array:
        """Copy numbers to the device."""
        return self.device.upload(values, dtype)

    def zeros(self, x: Array) -> Array:
        """Allocate a vector like `x`, all 0."""
        return vectors.fill(x.like(), 0.0)

    def directions(self, count: int, purpose: str) -> Array:
        """Allocate `count` vectors, each in a row; refuse `purpose` if there is no room."""
        size = self.rows * self.k
        self.device.require(4 * count * size, purpose)
        return self.device.empty((count, size))

    def state(self) -> Array:
        """Allocate rows of numbers, all 0, and room for the squared residuals of `SLOTS` steps."""
        rows = STATE_ROWS + SLOTS * self.slices
        return vectors.fill(self.device.empty((rows, self.k)), 0.0)

    def run(
        self,
        launches: Sequence[Callable[[], object]],
        updates: Sequence[Launch],
        steps: range,
        state: Array,
    ) -> StepReadings:
        """Queue these steps, each by all `launches`; then read the state, which waits.

        `updates` are those of the launches that need the number of the step.
        """
        self.queue_steps(launches, updates, steps)
        return self.read(state, steps)

    @staticmethod
    def queue_steps(
        launches: Sequence[Callable[[], object]], updates: Sequence[Any], steps: range
    ) -> None:
        """Queue these steps; see `run`."""
        for step in steps:
            for update in updates:
                update.set(iteration=step)
            for launch in launches:
                launch()

    def read(self, state: Array, steps: range) -> StepReadings:
        """Read the state after these steps, which waits."""
        numbers = state.get().astype(np.float64)
        partial_squares = numbers[STATE_ROWS:].reshape(SLOTS, self.slices, self.k)
        squares = partial_squares[np.asarray(steps) % SLOTS].sum(axis=1)
        return StepReadings(state=numbers[:STATE_ROWS], norms=np.sqrt(squares))


def column_reductions(x: Vector, *kernels: str) -> Any:
    """Sums over columns of vectors like `x`, an array of one device or in shares of several."""
    if isinstance(x, SharedVector):
        return SharedColumns(x, [ColumnReductions(part, *kernels) for part in x.parts])
    return ColumnReductions(x, *kernels)
