# SPDX-License-Identifier: BSD-3-Clause
"""A matrix on several devices of a platform, which multiply at the same time.

Each device has as many rows as it is fast: a dense product is timed once per device, and the time
is remembered. `ltcl.operators.shares` says how vectors go between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, exchange, tuning
from ltcl.operators.base import Operator
from ltcl.operators.csr import Pattern, RowBlocks
from ltcl.operators.dense import Dense, Filled, is_filled
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.parts import upload_part
from ltcl.operators.rows import ReadableRows, RowOperator
from ltcl.operators.shared_vector import RowShares
from ltcl.operators.shares import Share, SharedStepper, bind_product, bind_transpose
from ltcl.operators.stepper import Stepper

# Rows and columns of the product by which devices are compared: beyond the caches.
TIMED_ROWS = 4096

# (first row, rows) -> rows
ChangeRows = Callable[[int, Any], Any]


class MultiDevice(ReadableRows):
    """Rows of a matrix on several devices, whose products run at the same time.

    Parameters
    ----------
    device : Device
        Device of the vectors.
    parts : sequence of RowOperator, (rows, N) each
        From the first row on, each on its own device.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.operators import Dense, MultiDevice
    >>> device = ltcl.open_device()
    >>> A = MultiDevice(device, [Dense(device, [[1.0, 2.0]]), Dense(device, [[0.0, 3.0]])])
    >>> (A @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    # Methods that read rows on one device refuse it, and say this.
    where = "on several devices"

    def __init__(self, device: Device, parts: Sequence[RowOperator]) -> None:
        self.shares: list[Share] = []
        first = 0
        for rows in parts:
            self.shares.append(Share(first, rows))
            first += rows.shape[0]
        super().__init__(device, (first, parts[0].shape[1]), *parts)

    @property
    def parts(self) -> list[tuple[int, RowOperator]]:
        """(first row, rows) of each device."""
        return [(share.first, share.rows) for share in self.shares]

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """(first row, rows) of all parts."""
        for start, operator in self.parts:
            for first, rows in operator.blocks():
                yield start + first, rows

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Steps that exchange the rows of one vector; see `Operator.stepper`."""
        if all(share.device is not self.device for share in self.shares):
            return super().stepper(x, r, slots, a, c)
        return SharedStepper(self.shares, x, r, slots, a, c)

    def row_shares(self, a: float = 1.0, c: float = 0.0) -> RowShares | None:
        """Rows of devices that copy among themselves; see `Operator.row_shares`.

        Through the host each exchange of a few sums would wait, several times a product.
        """
        devices = {share.device for share in self.shares}
        are_near = all(exchange.are_near(self.device, device) for device in devices)
        has_one_share_each = self.device in devices and len(devices) == len(self.shares)
        if not (are_near and has_one_share_each):
            return None
        return RowShares(self.device, tuple(self.shares), a, c)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        bind = bind_transpose if transpose else bind_product
        return bind(self.device, self.shares, x, out, epilogue)


def upload_matrix(
    device: Device,
    matrix: Any,
    change: ChangeRows | None = None,
    pattern: Pattern | None = None,
    added_entries: int = 0,
) -> Any:
    """An operator from an array, a sparse matrix or a store, on a device and the others beside it.

    Parameters
    ----------
    device : Device
    matrix : (M, N) array, scipy.sparse array, or an object with ``row_blocks()``
        Rows of a store are uploaded block by block.
    change : function (first row, rows) -> rows, optional
        Applied to the rows before they are uploaded.
    pattern : Pattern, optional
        Pattern of another channel, for a sparse matrix on one device.
    added_entries : int
        The most entries that `change` adds to a store.
    """
    if change is None:
        change = _unchanged
    if hasattr(matrix, "row_blocks"):
        return _upload_store(device, matrix, change, added_entries)
    if not device.others:
        if isinstance(matrix, np.ndarray):
            Dense.begin(device, matrix.shape)
        return upload_part(device, change(0, matrix), pattern)
    if scipy.sparse.issparse(matrix):
        matrix = checks.csr("matrix", matrix)
    else:
        matrix = checks.real("matrix", matrix)

    def upload_rows(part_device: Device, rows: slice) -> RowOperator:
        return upload_part(part_device, change(rows.start, matrix[rows]))

    A: Any = split_over_devices(device, matrix.shape[0], upload_rows)
    A.exact_form = Float64Form(matrix=matrix)
    return A


def _unchanged(_: int, rows: Any) -> Any:
    return rows


def _upload_store(device: Device, store: Any, change: ChangeRows, added_entries: int) -> Any:
    M, N = store.shape

    def upload_rows(part_device: Device, share: slice) -> RowOperator:
        def blocks() -> Iterator[tuple[int, Any]]:
            for first, rows in store.row_blocks():
                start = max(share.start - first, 0)
                stop = min(share.stop - first, rows.shape[0])
                if start < stop:
                    yield first + start - share.start, change(first, rows)[start:stop]

        count = share.stop - share.start
        nnz = (store.nnz + added_entries) * count // M
        if is_filled((count, N), nnz):
            return Filled(part_device, (count, N), blocks)
        return RowBlocks(part_device, (count, N), blocks, nnz)

    return split_over_devices(device, M, upload_rows)


def split_over_devices(
    device: Device, rows: int, upload_rows: Callable[[Device, slice], RowOperator]
) -> Operator:
    """All rows on one device, or a share of them on each of several devices or ranks."""
    split_over_ranks = getattr(device, "split_over_ranks", None)
    if split_over_ranks is not None:
        return split_over_ranks(rows, upload_rows)
    if not device.others:
        return upload_rows(device, slice(0, rows))
    devices = [device, *device.others]
    speeds = np.array([1.0 / _product_seconds(part_device) for part_device in devices])
    ends = np.rint(rows * np.cumsum(speeds) / speeds.sum()).astype(int).tolist()
    # The device of the vectors takes part in steps.
    ends[0] = max(ends[0], 1)
    parts = []
    start = 0
    for part_device, end in zip(devices, ends, strict=True):
        if end > start:
            parts.append(upload_rows(part_device, slice(start, end)))
        start = end
    if len(parts) == 1:
        return parts[0]
    return MultiDevice(device, parts)


def _product_seconds(device: Device) -> float:
    """Seconds of a dense product, measured once per device and then remembered."""
    n = min(TIMED_ROWS, int((device.max_allocation // 8) ** 0.5))
    A = Dense(device, np.ones((n, n), np.float32))
    name = f"dense product of {n} rows, {device.compute_units} units"
    return tuning.work_seconds(device, name, A.bind(device.empty(n), device.empty(n)))
