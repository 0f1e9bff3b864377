# SPDX-License-Identifier: BSD-3-Clause
"""Dense matrices: float32, row-major, y = A x and y = A^T x by `kernels/dense.cl`, one copy for both."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators.base import Epilogue, widths
from ltcl.operators.rows import RowOperator, Slab, cut

_CHUNKS, _CHUNK_ROWS = (
    64,
    32,
)  # of a transposed product: enough groups for a large GPU, none too short


class Dense(RowOperator):
    """A dense (M, N) matrix on the device.

    Parameters
    ----------
    matrix : (M, N) array of real numbers
        InputError where some are not finite, MemoryLimitError where the device has no room for it.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense
    >>> A = Dense(ltcl.open_device(), [[1.0, 2.0], [0.0, 3.0]])
    >>> (A.T @ numpy.array([1.0, 1.0])).tolist()
    [1.0, 5.0]
    """

    file = "dense"
    exact: tuple[np.ndarray, ...] | None = (
        None  # (A, d, e): it is A / d - diag(e), rounded to float32
    )

    def __init__(self, device: Device, matrix: Any) -> None:
        host = checks.real("matrix", matrix)
        if host.ndim != 2:
            raise InputError(f"matrix has shape {host.shape}; it must be (M, N)")
        checks.finite("matrix", host)
        super().__init__(device, host.shape)
        device.require(4 * host.size, f"a dense matrix {host.shape}")
        self.defines = {"STRIP": 256 if device.is_cpu else 1}
        self._ones: Array | None = None
        self.slabs = self.upload(host)

    def upload(self, host: np.ndarray, first: int = 0) -> list[Slab]:
        """Slabs of rows from `first` on."""
        rows, width = host.shape
        cuts = cut(self.device, np.full(rows, 4 * max(width, 1)), "the dense matrix")
        return [Slab(first + a, b - a, (width, self.device.upload(host[a:b]))) for a, b in cuts]

    def blocks(self) -> Iterator[tuple[int, np.ndarray]]:
        """Slab by slab, as they lie on the device."""
        for slab in self.slabs:
            yield slab.first, slab.arguments[1].get().astype(np.float64)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        checks.fits_host(f"a dense matrix {self.shape}", 4 * self.shape[0] * self.shape[1])
        return {"matrix": np.concatenate([slab.arguments[1].get() for slab in self.slabs])}

    @classmethod
    def from_arrays(cls, device: Device, arrays: Mapping[str, np.ndarray]) -> Dense:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        return cls(device, arrays["matrix"])

    def _bound_transpose(self, x: Array, out: Array, epilogue: Epilogue) -> Callable[[], object]:
        return functools.partial(self._transposed_product, x, out, epilogue)

    def _transposed_product(self, x: Array, out: Array, epilogue: Epilogue) -> None:
        """Slab by slab, in chunks of rows where there are more work-items to feed than columns."""
        strip = self.defines["STRIP"]
        items, group = -(-self.shape[1] // strip), 1 if strip > 1 else 64
        for slab in self.slabs:
            chunks = 1 if strip > 1 else max(1, min(_CHUNKS, -(-slab.rows // _CHUNK_ROWS)))
            a, b, y, c = epilogue
            y = out if y is None else y
            sums = out if chunks == 1 else self.device.empty((chunks, *out.shape))
            for offset, width in widths(x.columns):
                kernel = self.kernel("dense_rmatvec", width, x.columns)
                place = (slab.rows, slab.first, x.columns, offset)
                kernel((items, chunks), (group, 1), *place, a, b, c, x, y, sums, *slab.arguments)
            if chunks > 1:
                self._ones = self._ones or self.device.upload(np.ones(_CHUNKS))
                place = (chunks, 0, 1, 0, 1.0, 0.0, 0.0)
                kernel = self.kernel("dense_rmatvec", 1, 1)
                kernel((out.size, 1), (64, 1), *place, self._ones, out, out, out.size, sums)
            epilogue = Epilogue(
                a, 1.0, out
            )  # the following slabs add to what the first has written
