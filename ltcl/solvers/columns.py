# SPDX-License-Identifier: BSD-3-Clause
"""Right-hand sides with coefficients of their own: sums over the rows of (N, k) arrays, column by column.

The kernels leave one sum a column in each of a few slices of the rows; each group of the next kernel adds the
slices up itself and works out the coefficients of its columns, so that none of them comes to the host.
"""

from __future__ import annotations

import numpy as np

from ltcl.device import Array, vectors
from ltcl.device.kernels import Launch

STATE, SLOTS = 16, 8  # rows of numbers that a method leaves in its state; steps whose residuals follow them
_VALUES = 32  # an item should have, before there are more groups
_SLICES = 256  # at most, as many as groups


def ratio(numerator: np.ndarray, denominator: np.ndarray, where: np.ndarray) -> np.ndarray:
    """numerator / denominator in the columns `where` a step is taken, 0 in those that rest.

    A denominator beyond float32 gives NaN, not a step of 0 that would be repeated for ever.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # the monitor sees what comes of it
        return np.where(where, numerator / np.where(np.isfinite(denominator), denominator, np.nan), 0.0)


class Columns:
    """How the kernels of one file that include `common/columns.h` run on arrays like `x`, (N,) or (N, k)."""

    def __init__(self, x: Array, file: str, *kernels: str) -> None:
        self.device, self.k, self.rows = x.device, x.columns, x.shape[0]
        on_cpu = self.device.is_cpu
        self._kernels = {name: self.device.kernel(file, name, ADJACENT=int(on_cpu)) for name in kernels}
        wanted = (16 if self.k <= 16 else 64) if on_cpu else 256
        self.group = min(kernel.group(wanted) for kernel in self._kernels.values())
        most = 4 * self.device.compute_units if on_cpu else _SLICES
        self.slices = max(1, min(-(-x.size // (_VALUES * self.group)), most, _SLICES))

    def bind(self, name: str, *arguments: object, extra: int = 0, across: int = 1, rows: int = 0) -> Launch:
        """Kernel `name` on `rows` rows, `across` times, with local memory for `extra` reals a column."""
        scratch = self.device.local(self.group + extra * min(self.k, self.group))
        sizes = rows or self.rows, self.k
        return self._kernels[name].bind(self.items(across), (self.group, 1, 1), *sizes, *arguments, scratch)

    def items(self, across: int) -> tuple[int, int, int]:
        """Work-items of a launch, `across` times."""
        return self.slices * self.group, across, -(-self.k // self.group)

    @property
    def room(self) -> int:
        """Reals a column that local memory has room for."""
        return (self.device.local_memory // 4 - self.group) // min(self.k, self.group)

    def sums(self, count: int) -> Array:
        """Room for `count` partial sums of each column."""
        return self.device.empty((self.slices * count, self.k))

    def state(self) -> Array:
        """`STATE` rows of numbers, all 0, and room for the squares of the residuals of `SLOTS` steps."""
        return vectors.fill(self.device.empty((STATE + SLOTS * self.slices, self.k)), 0.0)

    def read(self, state: Array, first: int, step: int) -> tuple[np.ndarray, np.ndarray]:
        """The numbers of a state (STATE, k), and the residual norms of steps `first` to `step` (steps, k)."""
        numbers = state.get().astype(np.float64)
        squares = numbers[STATE:].reshape(SLOTS, self.slices, self.k)[np.arange(first, step) % SLOTS]
        return numbers[:STATE], np.sqrt(squares.sum(axis=1))
