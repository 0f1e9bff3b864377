# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose matrix lies on the device as slabs of rows: how their products and steps are launched.

Kernels are those of `kernels/common/product.h`: they take its arguments, a slab's and local memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, tuning, vectors
from ltcl.device.device import SPARE_BYTES
from ltcl.device.kernels import Kernel, Launch
from ltcl.errors import MemoryLimitError
from ltcl.operators.base import PLAIN, Epilogue, Norms, Operator, Stepper, widths

_KEEP, _GAIN, _GROUP_AT = 6, 7, 8  # arguments of a step that change, see kernels/common/product.h


@dataclass(frozen=True)
class Slab:
    """Rows first .. first + rows of the matrix; `arguments` are what the format's kernels take for it."""

    first: int
    rows: int
    arguments: tuple[Any, ...]

    @property
    def nbytes(self) -> int:
        """Bytes of its buffers."""
        return sum(argument.nbytes for argument in self.arguments if isinstance(argument, Array))


@dataclass(frozen=True)
class Variant:
    """A kernel over rows: work-groups of `group` items, which share a row or have one each."""

    suffix: str
    group: int
    shared: bool

    def shape(self, kernel: Kernel, rows: int, width: int) -> tuple[int, int, Any]:
        """Work-items, work-group and local memory of a launch over `rows` with `width` right-hand sides."""
        group = kernel.group(self.group)
        return (rows * group if self.shared else rows), group, kernel.device.local(width * group)


class ReadableRows(Operator):
    """An operator whose entries the host can read. Subclasses give `blocks`."""

    # (first row, rows on the host): float64 arrays or csr_arrays (rows, N) of what it stands for.
    blocks: Callable[[], Iterator[tuple[int, Any]]]

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        diagonal = np.zeros(min(self.shape))
        for first, rows in self.blocks():
            here = rows.diagonal(first)
            diagonal[first : first + len(here)] = here
        return diagonal

    def norms(self) -> Norms:
        """Norms of what it stands for, in float64."""
        columns, inf, squares, lowest = self.sums()
        return Norms(float(columns.max(initial=0.0)), inf, squares**0.5, lowest)

    def sums(self) -> tuple[np.ndarray, float, float, float]:
        """Of |A_ij| in each column, (N,), and the largest of a row; of squares; and the lowest entry or 0."""
        columns, inf, squares, lowest = np.zeros(self.shape[1]), 0.0, 0.0, 0.0
        for _, rows in self.blocks():
            values = rows.data if scipy.sparse.issparse(rows) else rows
            squares += float(np.vdot(values, values))
            lowest = min(lowest, float(values.min(initial=0.0)))
            sizes = abs(rows)
            columns += sizes.sum(axis=0)
            inf = max(inf, float(sizes.sum(axis=1).max(initial=0.0)))
        return columns, inf, squares, lowest

    def _dense(self) -> np.ndarray:
        dense = np.empty(self.shape)
        for first, rows in self.blocks():
            here = rows.toarray() if scipy.sparse.issparse(rows) else rows
            dense[first : first + len(here)] = here
        return dense


class RowOperator(ReadableRows):
    """An operator stored as slabs of rows. Subclasses set `file`, `defines`, `slabs`, and give `blocks`."""

    file: str  # stem of the kernel file
    defines: dict[str, Any]
    unit = 1.0  # of the numbers in the slabs
    slabs: list[Slab]
    _transposed_rows: Callable[[], RowOperator]

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        super().__init__(device, shape)
        self.defines = {}
        self._fastest: dict[tuple[int, int], Variant] = {}
        self._transposed: RowOperator | None = None
        self.relaxations: dict[tuple[Any, ...], Any] = {}  # of relaxation.py: lives as long
        self.tables: dict[str, Any] = {}  # of walks.py

    def arrays(self) -> set[Array]:
        """Of all slabs, and of the transpose once it was asked for."""
        arrays = {x for slab in self.slabs for x in slab.arguments if isinstance(x, Array)}
        return arrays if self._transposed is None else arrays | self._transposed.arrays()

    def transposed_copy(self) -> RowOperator:
        """A^T in rows of its own, made at the first call and kept."""
        if self._transposed is None:
            self._transposed = self._transposed_rows()
        return self._transposed

    def variants(self) -> dict[str, Variant]:
        """The kernels and work-groups that make a product here, the default first."""
        if self.device.is_cpu:
            return {"item": Variant("", 16, shared=False)}
        groups = [size for size in (32, 64, 128, 256) if size <= self.device.max_group]
        shared = {f"group{size}": Variant("_group", size, shared=True) for size in groups}
        return shared | {"item": Variant("", 64, shared=False)}

    def fastest(self, x: Array, width: int) -> Variant:
        """The variant for products with `width` of the right-hand sides `x`, timed at the first call."""
        key = (width, x.columns)
        if key in self._fastest:
            return self._fastest[key]
        variants, slab = self.variants(), max(self.slabs, key=lambda slab: slab.nbytes)
        best = next(iter(variants))
        if (
            len(variants) > 1
        ):  # timed on the real matrix, into an array nobody needs: `out` may be an operand
            spare = self.device.empty((self.shape[0], *x.shape[1:]))
            trials = {
                name: self._launch(v, slab, x, spare, 0, width, PLAIN)
                for name, v in variants.items()
            }
            row = slab.nbytes // max(slab.rows, 1)
            kind = " ".join(f"{name}={value}" for name, value in sorted(self.defines.items()))
            problem = f"{kind} k={width} of {x.columns}, rows of about 2^{row.bit_length()} bytes"
            best = tuning.choose(self.device, self.file, problem, trials)
        self._fastest[key] = variants[best]
        return variants[best]

    def kernel(self, name: str, width: int, columns: int, **defines: int) -> Kernel:
        """The kernel `name` for `width` of `columns` right-hand sides."""
        packed = {"PACKED": 1} if width == columns else {}
        return self.device.kernel(self.file, name, K=width, **packed, **defines, **self.defines)

    def _launch(
        self,
        variant: Variant,
        slab: Slab,
        x: Array,
        out: Array,
        offset: int,
        width: int,
        epilogue: Epilogue,
    ) -> Callable[[], None]:
        kernel = self.kernel(f"{self.file}_matvec{variant.suffix}", width, x.columns)
        items, group, local = variant.shape(kernel, slab.rows, width)
        a, b, y, c = epilogue
        numbers = (slab.rows, slab.first, x.columns, offset, a * self.unit, b, c)
        operands = (x, out if y is None else y, out)
        return kernel.bind(items, group, *numbers, *operands, *slab.arguments, local)

    def _bound(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        if transpose:
            return self._bound_transpose(x, out, epilogue)
        launches = [
            self._launch(self.fastest(x, width), slab, x, out, offset, width, epilogue)
            for offset, width in widths(x.columns)
            for slab in self.slabs
        ]
        return launches[0] if len(launches) == 1 else lambda: [launch() for launch in launches]

    def _bound_transpose(self, x: Array, out: Array, epilogue: Epilogue) -> Callable[[], object]:
        return self.transposed_copy()._bound(x, out, epilogue, False)

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Steps of one launch each; see `Operator.stepper`."""
        return RowStepper(self, x, r, slots, a * self.unit, c)


class RowStepper(Stepper):
    """Steps of one launch a slab and eight right-hand sides."""

    A: RowOperator

    def _prepare(self) -> None:
        A, columns = self.A, self.x.columns
        pieces, ends = [], []
        for offset, width in widths(columns):
            variant, at = A.fastest(self.x, width), 0
            for slab in A.slabs:
                kernel = A.kernel(f"{A.file}_matvec{variant.suffix}", width, columns, STEP=1)
                shape = variant.shape(kernel, slab.rows, width)
                pieces.append((kernel, shape, slab, offset, at))
                at += -(-shape[0] // shape[1])
            ends.append(at)
        self._groups = max(ends, default=1)
        self._partials = A.device.empty((self.slots, self._groups, columns))
        if len(set(ends)) > 1:
            vectors.fill(
                self._partials, 0.0
            )  # some pieces of right-hand sides have fewer groups than others
        # The direction is read by many rows while the next one is written: the two take turns.
        self._turns: list[list[tuple[Launch, int]]] = [[], []]
        for turn, (d, following) in zip(
            self._turns, permutations((self.d, self.other)), strict=True
        ):
            for kernel, (items, group, local), slab, offset, at in pieces:
                numbers = (slab.rows, slab.first, columns, offset, self._a, self._c, 0.0, 0.0, at)
                arrays = (d, self.x, self.r, following, self._partials, *slab.arguments)
                turn.append((kernel.bind(items, group, *numbers, *arrays, local), at))

    def step(self, keep: float, gain: float) -> None:
        """Queue one step; see `Stepper.step`."""
        for launch, at in self._turns[0]:
            launch.set(_KEEP, keep)
            launch.set(_GAIN, gain)
            launch.set(_GROUP_AT, self.waiting * self._groups + at)
            launch()
        self._turns.reverse()
        self.d, self.other = self.other, self.d
        self.waiting += 1


def cut(
    device: Device, row_bytes: np.ndarray, what: str, itemsize: int = 4
) -> list[tuple[int, int]]:
    """Rows (start, stop) of as few slabs as possible whose buffer, of `row_bytes` (M,), the device takes."""
    # Kernels count in 32 bits, also a work-group beyond the end of a row; pointers are rows + 1.
    limit = min(device.max_allocation - SPARE_BYTES - 4, itemsize * ((1 << 31) - 4096))
    ends = np.concatenate([[0], np.cumsum(row_bytes, dtype=np.int64)])
    pieces, start = [], 0
    while start < len(row_bytes):
        stop = int(np.searchsorted(ends, ends[start] + limit, side="right")) - 1
        if stop == start:
            row = checks.size(int(row_bytes[start]))
            raise MemoryLimitError(
                f"row {start} of {what} has {row}, the largest buffer of this device {checks.size(limit)}"
            )
        pieces.append((start, stop))
        start = stop
    return pieces or [(0, 0)]
