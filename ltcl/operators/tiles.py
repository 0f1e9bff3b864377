# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices as rows of tiles of narrow numbers, y = A x by `kernels/tile.cl`.

The format is that of `ltcl.operators.tile_packing`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.rows import Slab, SparseRows, cut
from ltcl.operators.tile_packing import (
    PRECISIONS,
    WIDTHS,
    Packed,
    check_packed,
    pack,
    quantize,
    smallest,
)

__all__ = ["PRECISIONS", "WIDTHS", "Packed", "Tiles", "pack", "quantize", "smallest"]


class Tiles(SparseRows):
    """A sparse (M, N) matrix in tiles on the device.

    Parameters
    ----------
    device : Device
    matrix : scipy.sparse matrix or array, (M, N), or a result of `pack`
    width : 1 or 8
        Neighbouring columns of a tile; 1 is for scattered nonzeros.
    precision : str
        "float32", "float16" (11 significant bits) or "int8" (7, with a scale for each tile).

    Attributes
    ----------
    quantisation, error : float
        Frobenius norm of the change by rounding, and a bound on its 2-norm.

    Raises
    ------
    InputError
        If the matrix is malformed or not finite, also in float32.
    MemoryLimitError
        If the device has no room for it.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> from ltcl.operators import Tiles
    >>> matrix = scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.01]])
    >>> A = Tiles(ltcl.open_device(), matrix, 1, "float16")
    >>> (A @ numpy.array([1.0, 1.0])).tolist(), round(A.quantisation, 4)
    ([3.0, 3.009765625], 0.0002)
    """

    file: ClassVar[str] = "tile"
    numbers: ClassVar[str] = "values"

    def __init__(
        self, device: Device, matrix: Any, width: int = 8, precision: str = "float16"
    ) -> None:
        packed = matrix if isinstance(matrix, Packed) else pack(matrix, width, precision)
        super().__init__(device, packed.shape)
        device.require(packed.nbytes, f"a matrix of {packed.codes.size} numbers in tiles")
        self.packed = packed
        self.quantisation, self.error = packed.difference
        self.frobenius = float(np.linalg.norm(packed.decoded()))
        self.width = packed.width
        self.precision = packed.precision
        self.unit = packed.unit
        # A tile, whose numbers are one load.
        self.entries_of_turn = self.width
        self.defines = {
            "WIDTH": self.width,
            "VALUES": list(PRECISIONS).index(self.precision),
            "PLACE": "ushort" if packed.columns.itemsize == 2 else "int",
        }
        self.build_ahead(device, self.shape, packed.nbytes, self.defines)
        self.slabs = self._upload_slabs()

    def _upload_slabs(self) -> list[Slab]:
        packed = self.packed
        itemsize = packed.codes.itemsize
        tile_bytes = max(packed.width * itemsize, packed.columns.itemsize)
        row_bytes = np.maximum(tile_bytes * np.diff(packed.pointers), 4)
        slabs = []
        for start, stop in cut(self.device, row_bytes, "the matrix of tiles", itemsize):
            pointers = packed.pointers[start : stop + 1]
            tiles = slice(pointers[0], pointers[-1])
            columns = self.device.upload(packed.columns[tiles], packed.columns.dtype)
            codes = self.device.upload(packed.codes[tiles], packed.codes.dtype)
            # Scales are not read if there are none, but a kernel needs a buffer.
            scales = columns
            if packed.scales.size:
                scales = self.device.upload(packed.scales[tiles], np.uint8)
            arguments = {
                "pointers": self.device.upload(pointers - pointers[0], np.int32),
                "columns": columns,
                "values": codes,
                "scales": scales,
            }
            slabs.append(Slab(start, stop - start, arguments))
        return slabs

    def matrix(self) -> scipy.sparse.csr_array:
        """The matrix (M, N) that the tiles hold, float64, exact."""
        return self.packed.matrix()

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """The whole matrix in one block."""
        yield 0, self.matrix()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, from which `from_arrays` makes the same operator, to the bit."""
        packed = self.packed
        has_wide_columns = packed.columns.itemsize == 4
        return {
            "shape": np.array(packed.shape, np.int64),
            "layout": np.array([packed.width, 1, 1, has_wide_columns], np.int64),
            "pointers": packed.pointers,
            "starts": packed.columns,
            "precision": np.array(packed.precision),
            "codes": packed.codes,
            "scales": packed.scales,
            "unit": np.array(packed.unit),
            "difference": np.array(packed.difference),
        }

    @classmethod
    def from_arrays(cls, device: Device, arrays: Mapping[str, np.ndarray]) -> Tiles:
        """The operator whose `to_arrays` gave `arrays`; arrays that do not fit are refused."""
        precision = str(arrays["precision"])
        layout = [int(n) for n in arrays["layout"]]
        if precision not in PRECISIONS or layout[0] not in WIDTHS or layout[1:3] != [1, 1]:
            raise InputError(
                f"stored tiles have the layout {layout} in {precision}; it must be 1 or 8 columns "
                f"in {', '.join(PRECISIONS)}: compress again"
            )
        rows, columns = arrays["shape"]
        frobenius, bound = arrays["difference"]
        packed = Packed(
            shape=(int(rows), int(columns)),
            pointers=np.asarray(arrays["pointers"]),
            columns=np.asarray(arrays["starts"]),
            precision=precision,
            codes=np.asarray(arrays["codes"]),
            scales=np.asarray(arrays["scales"]),
            unit=float(arrays["unit"]),
            difference=(float(frobenius), float(bound)),
        )
        check_packed(packed, layout[0])
        return cls(device, packed)

    def _frobenius_norm(self) -> float:
        return self.frobenius

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        return Float64Form(matrix=self.matrix())

    def _transposed_rows(self) -> Tiles:
        return Tiles(self.device, self.packed.transposed())
