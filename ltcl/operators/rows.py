# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose matrix lies on the device as slabs of rows: how their products are launched.

Kernels of such a format `f` share their arguments, `(rows, first, stride, offset, scale, adds, <slab>, x,
add, out)`, and come as `f_matvec`, `f_matvec_stream` and `f_matvec_group`; see `kernels/csr.cl`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ltcl.device import Array, Device, tuning
from ltcl.device.kernels import Kernel
from ltcl.operators.base import Operator, widths

_WORTH_TIMING = 1 << 20  # bytes; below, a product takes as long as its launch and timing tells nothing


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
class Launch:
    """One way to run a kernel over rows: `group` items share a row, or each item has its own (0)."""

    kernel: Kernel
    group: int

    def __call__(self, rows: int, *arguments: Any) -> None:
        """Queue the kernel over `rows` rows."""
        if self.group:
            local = self.kernel.device.local(self.group)
            self.kernel(rows * self.group, self.group, rows, *arguments, local)
        else:
            self.kernel(rows, 16 if self.kernel.device.is_cpu else 64, rows, *arguments)


class RowOperator(Operator):
    """An operator stored as slabs of rows. Subclasses set `file`, `defines` and `slabs`."""

    file: str  # stem of the kernel file
    defines: Mapping[str, Any]
    slabs: list[Slab]

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        super().__init__(device, shape)
        self._fastest: dict[tuple[int, int], Launch] = {}
        self.relaxations: dict[tuple[Any, ...], Any] = {}  # of relaxation.py: lives as long
        self.tables: dict[str, Any] = {}  # of alias.py

    @property
    def nbytes(self) -> int:
        """Bytes of the matrix on the device."""
        return sum(slab.nbytes for slab in self.slabs)

    def kernel(self, name: str, width: int, columns: int) -> Kernel:
        """The kernel `name` for `width` of `columns` right-hand sides."""
        packed = {"PACKED": 1} if width == columns else {}
        return self.device.kernel(self.file, name, K=width, **packed, **self.defines)

    def variants(self, width: int, columns: int) -> dict[str, Launch]:
        """The ways to run a product with `width` of `columns` right-hand sides here, the default first."""

        def launch(suffix: str, group: int) -> Launch:
            return Launch(self.kernel(f"{self.file}_matvec{suffix}", width, columns), group)

        if self.device.is_cpu:
            return {"stream": launch("_stream", 0), "item": launch("", 0)}
        groups = [size for size in (32, 64, 128, 256) if size <= self.device.max_group]
        return {**{f"group{size}": launch("_group", size) for size in groups}, "item": launch("", 0)}

    def _forward(self, x: Array, out: Array, scale: float, add: Array | None) -> None:
        for offset, width in widths(x.columns):
            launch = self.fastest(x, width)
            for slab in self.slabs:
                _run(launch, slab, x, offset, out, scale, add)

    def fastest(self, x: Array, width: int) -> Launch:
        """The way to run products with `width` of the right-hand sides `x`, timed at the first call."""
        key = (width, x.columns)
        if key not in self._fastest:
            self._fastest[key] = self._measure(x, width)
        return self._fastest[key]

    def _measure(self, x: Array, width: int) -> Launch:
        variants = self.variants(width, x.columns)
        slab = max(self.slabs, key=lambda slab: slab.nbytes)
        if slab.nbytes < _WORTH_TIMING:
            return next(iter(variants.values()))
        # Timed on the real matrix, into an array nobody needs: `out` may be an operand.
        spare = self.device.empty((self.shape[0], *x.shape[1:]))
        trials = {
            name: lambda launch=launch: _run(launch, slab, x, 0, spare, 1.0, None)
            for name, launch in variants.items()
        }
        row = slab.nbytes // slab.rows
        problem = f"k={width} of {x.columns}, rows of about 2^{row.bit_length()} bytes"
        return variants[tuning.choose(self.device, self.file, problem, trials)]


def _run(
    launch: Launch, slab: Slab, x: Array, offset: int, out: Array, scale: float, add: Array | None
) -> None:
    adds, added = (0, out) if add is None else (1, add)
    launch(slab.rows, slab.first, x.columns, offset, scale, adds, *slab.arguments, x, added, out)
