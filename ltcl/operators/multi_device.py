# SPDX-License-Identifier: BSD-3-Clause
"""A matrix on several devices of a platform, which multiply at the same time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, tuning
from ltcl.operators.base import Operator
from ltcl.operators.csr import Pattern, RowBlocks
from ltcl.operators.dense import Dense
from ltcl.operators.parts import Parts, upload_part
from ltcl.operators.rows import ReadableRows, RowOperator

_TRIAL = 4096  # rows and columns of the product by which devices are compared: beyond the caches


class MultiDevice(Parts, ReadableRows):
    """Rows of a matrix on several devices, whose products run at the same time.

    Parameters
    ----------
    device : Device
        Of the vectors.
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

    where = "on several devices"

    def __init__(self, device: Device, parts: Sequence[RowOperator]) -> None:
        ends = np.cumsum([part.shape[0] for part in parts]).tolist()
        super().__init__(device, (ends[-1], parts[0].shape[1]), *parts)
        self.parts = list(zip([0, *ends], parts, strict=False))  # (first row, rows)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """Those of all parts."""
        return (
            (start + first, rows) for start, part in self.parts for first, rows in part.blocks()
        )

    def _gathered(self, x: Array, transpose: bool) -> np.ndarray:
        host, products = x.get(), []
        for first, part in self.parts:
            own = host[first : first + part.shape[0]] if transpose else host
            A = part.T if transpose else part
            products.append(A.apply(part.device.upload(own)))
            part.device.flush()
        results = [product.get() for product in products]
        return np.sum(results, axis=0) if transpose else np.concatenate(results)


def upload_matrix(
    device: Device,
    matrix: Any,
    change: Callable[[int, Any], Any] = lambda first, rows: rows,
    pattern: Pattern | None = None,
    more: int = 0,
) -> Any:
    """An array, a sparse matrix or a store, after `change` of (first row, rows), on a device and its others.

    Rows of a store are uploaded block by block; `change` may give them so many `more` entries.
    """
    if not (stored := hasattr(matrix, "row_blocks")):
        if not device.others:
            return upload_part(device, change(0, matrix), pattern)
        check: Any = checks.csr if scipy.sparse.issparse(matrix) else checks.real
        matrix = check("matrix", matrix)

    def make(on: Device, own: slice) -> RowOperator:
        if not stored:
            return upload_part(on, change(own.start, matrix[own]))

        def blocks() -> Iterator[tuple[int, Any]]:
            for first, rows in matrix.row_blocks():
                start, stop = max(own.start - first, 0), min(own.stop - first, rows.shape[0])
                if start < stop:
                    yield first + start - own.start, change(first, rows)[start:stop]

        M, N, count = *matrix.shape, own.stop - own.start
        return RowBlocks(on, (count, N), blocks, (matrix.nnz + more) * count // M)

    A: Any = split_over_devices(device, matrix.shape[0], make)
    if not stored:
        A.exact = matrix, np.ones(A.shape[1]), np.zeros(A.shape[1])
    return A


def split_over_devices(
    device: Device, rows: int, make: Callable[[Device, slice], RowOperator]
) -> Operator:
    """What `make` puts on a device: all rows, or of several devices or ranks as many as each is fast."""
    if (split_over_ranks := getattr(device, "split_over_ranks", None)) is not None:
        return split_over_ranks(rows, make)
    devices = [device, *device.others]
    speeds = np.array([1.0 / _trial(each) for each in devices]) if device.others else np.ones(1)
    ends = np.rint(rows * np.cumsum(speeds) / speeds.sum()).astype(int).tolist()
    spans = zip(devices, map(slice, [0, *ends], ends), strict=False)
    parts = [make(each, own) for each, own in spans if own.stop > own.start]
    return parts[0] if len(parts) == 1 else MultiDevice(device, parts)


def _trial(device: Device) -> float:
    """Seconds of a dense product, measured once per device and then remembered."""
    n = min(_TRIAL, int((device.max_allocation // 8) ** 0.5))
    A = Dense(device, np.ones((n, n), np.float32))
    name = f"dense product of {n} rows, {device.compute_units} units"
    return tuning.seconds(device, name, A.bind(device.empty(n), device.empty(n)))
