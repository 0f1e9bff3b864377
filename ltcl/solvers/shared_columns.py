# SPDX-License-Identifier: BSD-3-Clause
"""Krylov methods on several devices: each updates its own rows of all vectors, at the same time.

Devices send each other their partial sums of inner products, a few numbers, and each computes the
coefficients of the step from all of them: alike devices get the same to the bit. The calls are
those of `ColumnReductions`, so that a method is written once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl.device import Array, exchange, vectors
from ltcl.device.kernels import Launch
from ltcl.operators import Operator
from ltcl.operators.shared_vector import SharedVector

if TYPE_CHECKING:
    from ltcl.solvers.column_reductions import ColumnReductions, StepReadings

# The argument in which a kernel leaves sums over rows, from value `first` on.
SUMS_LEFT_BY = {"vector_dots": "partials", "krylov_bicgstab": "next_partials"}


class DeviceArrays:
    """An array of each device, `parts`: the same numbers on all, or those of its own rows."""

    def __init__(self, parts: list[Array]) -> None:
        self.parts = parts

    def get(self) -> np.ndarray:
        """Copy the numbers of the first device to the host."""
        for part in self.parts:
            part.device.flush()
        return self.parts[0].get()

    def set(self, values: np.ndarray) -> None:
        """Overwrite with the same numbers on all devices."""
        for part in self.parts:
            part.set(values)

    def set_rows(self, first: int, block: DeviceArrays) -> None:
        """Overwrite the rows from `first` on, on each device with those of its block."""
        for part, block_part in zip(self.parts, block.parts, strict=True):
            part.set_rows(first, block_part)


class SharedSums(DeviceArrays):
    """Partial sums of all devices, (slices of all, count, k), on each device.

    Each device leaves those of its own rows at its place among them, and gets the others.
    """

    def __init__(self, parts: list[Array], slices: list[int], count: int) -> None:
        super().__init__(parts)
        self._slices = slices
        self.count = count

    def first_value(self, place: int) -> int:
        """The value with which the sums of a device begin."""
        return sum(self._slices[:place]) * self.count * self.parts[place].columns

    def exchange(self) -> None:
        """Queue the sums of each device to all others."""
        spans = []
        first = 0
        for slices in self._slices:
            count = slices * self.count
            spans.append(exchange.Span(first, first, count))
            first += count
        exchange.send_to_all(self.parts, spans, self.parts)


class SharedLaunch:
    """A launch on each device, behind which the sums that they leave are exchanged."""

    def __init__(self, launches: list[Launch], sums: SharedSums | None) -> None:
        self.launches = launches
        self.sums = sums

    def __call__(self) -> None:
        """Queue the launch on each device, then the exchange."""
        for launch in self.launches:
            launch()
        if self.sums is not None:
            self.sums.exchange()

    def set(self, /, **values: Any) -> None:
        """Change numbers for the launches that follow."""
        for launch in self.launches:
            launch.set(**values)


class SharedColumns:
    """Kernels that sum over columns, `of_devices` for the rows of each device of those of `x`."""

    def __init__(self, x: SharedVector, of_devices: list[ColumnReductions]) -> None:
        self.k = x.columns
        self._of_devices = of_devices
        self._slices = [columns.slices for columns in of_devices]
        self.slices = sum(self._slices)
        self._operands = [columns.device.empty(x.shape) for columns in of_devices]

    @property
    def max_totals(self) -> int:
        """Most totals of a column that a work-group holds."""
        return min(columns.max_totals for columns in self._of_devices)

    def bind(
        self, name: str, /, *, extra: int = 0, across: int = 1, **arguments: Any
    ) -> SharedLaunch:
        """Bind a kernel on each device; see `ColumnReductions.bind`."""
        left_in = SUMS_LEFT_BY.get(name)
        sums = None if left_in is None else arguments[left_in]
        launches = []
        for place, columns in enumerate(self._of_devices):
            own = {}
            for key, value in arguments.items():
                is_shared = isinstance(value, (SharedVector, DeviceArrays))
                own[key] = value.parts[place] if is_shared else value
            if sums is not None:
                own["first"] = sums.first_value(place)
            launches.append(columns.bind(name, extra=extra, across=across, **own))
        return SharedLaunch(launches, sums)

    def bind_product(self, S: Operator, x: SharedVector, out: SharedVector) -> Callable[[], object]:
        """Bind out = S x, where S is in the same shares."""
        del S
        return x.rows.bind(x, out, self._operands)

    def resize(self, dots: SharedLaunch, across: int) -> None:
        """Change how many inner products a launch makes."""
        sums = dots.sums
        if sums is not None:
            sums.count = across
        for place, (columns, launch) in enumerate(
            zip(self._of_devices, dots.launches, strict=True)
        ):
            columns.resize(launch, across)
            if sums is not None:
                launch.set(first=sums.first_value(place))

    def sums(self, count: int) -> SharedSums:
        """Allocate room for `count` partial sums of each column."""
        rows = self.slices * count
        parts = [columns.numbers(rows) for columns in self._of_devices]
        return SharedSums(parts, self._slices, count)

    def state(self) -> DeviceArrays:
        """Allocate the numbers of a method on each device, all 0."""
        return DeviceArrays([columns.state() for columns in self._of_devices])

    def numbers(self, rows: int) -> DeviceArrays:
        """Allocate rows of a number for each column, which all devices compute."""
        return DeviceArrays([columns.numbers(rows) for columns in self._of_devices])

    def upload(self, values: np.ndarray, dtype: Any = np.float32) -> DeviceArrays:
        """Copy numbers to all devices."""
        return DeviceArrays([columns.upload(values, dtype) for columns in self._of_devices])

    def zeros(self, x: SharedVector) -> SharedVector:
        """Allocate a vector like `x`, all 0."""
        return x.like().fill(0.0)

    def directions(self, count: int, purpose: str) -> DeviceArrays:
        """Allocate `count` vectors, each device its rows of them."""
        return DeviceArrays([columns.directions(count, purpose) for columns in self._of_devices])

    def apply_transpose(self, S: Operator, x: SharedVector, out: SharedVector) -> np.ndarray:
        """Compute out = S^T x at home; return the squares (k,) of the norms of its columns."""
        S.apply_transpose(x.gather(), out.whole)
        out.hand_out()
        return vectors.dot(out.whole, out.whole)

    def run(
        self,
        launches: Sequence[Callable[[], object]],
        updates: Sequence[SharedLaunch],
        steps: range,
        state: DeviceArrays,
    ) -> StepReadings:
        """Queue these steps, then read the state; see `ColumnReductions.run`."""
        self._of_devices[0].queue_steps(launches, updates, steps)
        for columns in self._of_devices:
            columns.device.flush()
        readings = []
        for columns, part in zip(self._of_devices, state.parts, strict=True):
            readings.append(columns.read(part, steps))
        squares = [reading.norms**2 for reading in readings]
        return dataclasses.replace(readings[0], norms=np.sqrt(np.sum(squares, axis=0)))
