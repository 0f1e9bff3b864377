# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices as rows of tiles of narrow numbers, y = A x by `kernels/tile.cl`.

A tile is 1 or 8 neighbouring columns of a row under one column index, of 16 bits where that
suffices: entries take 1.4 to 6 bytes where compressed sparse rows take 8. Tiles are laid greedily
from left to right, each beginning at the first nonzero that none before holds: there is no layout
of fewer. Numbers are rounded to nearest, a = unit * scale of the tile * code. `unit`, a power of
two, brings the largest near 2^15: subnormal numbers, which are left out since some devices take
them for zeros, are below 2^-28 of the largest. Codes of int8 share a scale of 5 bits of exponent
and 3 of fraction: float16 holds such a number exactly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.device.arrays import rounded
from ltcl.errors import InputError
from ltcl.operators.rows import RowOperator, Slab, cut

WIDTHS = (1, 8)
# In the order of VALUES in kernels/tile.cl.
PRECISIONS: dict[str, Any] = {"float32": np.float32, "float16": np.float16, "int8": np.int8}
_EXACT = {
    "float32": "float32",
    "float16": "float16",
    "int8": "float16",
}  # holds its numbers without scales
_LEAST = 2.0**-14  # of float16 that is not subnormal
_ARRAYS = ("pointers", "starts", "codes", "scales")


@dataclass(frozen=True, eq=False)
class Packed:
    """A matrix in tiles; made by `pack`."""

    shape: tuple[int, int]  # (M, N)
    pointers: np.ndarray  # (M + 1,) int64, the first tile of each row
    columns: (
        np.ndarray
    )  # (tiles,) uint16 or int32, the first of each; none reaches beyond the matrix
    precision: str
    codes: np.ndarray  # (tiles, width), zeros where no nonzero is
    scales: np.ndarray  # (tiles,) uint8 of int8, else (0,)
    unit: float
    difference: tuple[
        float, float
    ]  # from what was packed: its Frobenius norm, and a bound on its 2-norm

    @property
    def width(self) -> int:
        """Columns of a tile."""
        return self.codes.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of it, with 32-bit pointers as the device has them."""
        return 4 * len(self.pointers) + self.columns.nbytes + self.codes.nbytes + self.scales.nbytes

    def decoded(self) -> np.ndarray:
        """The numbers that codes stand for, (tiles, width) float64."""
        numbers = self.codes.astype(np.float64) * self.unit
        return numbers * _scale(self.scales)[:, None] if self.scales.size else numbers

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N) float64, exact."""
        tile, lane = np.nonzero(self.codes)
        row = np.repeat(np.arange(self.shape[0]), np.diff(self.pointers))
        places = row[tile], self.columns[tile].astype(np.int64) + lane
        return scipy.sparse.csr_array((self.decoded()[tile, lane], places), shape=self.shape)

    def transposed(self) -> Packed:
        """The same numbers transposed, without scales, in tiles of the width that takes fewest bytes."""
        matrix, precision = scipy.sparse.csr_array(self.matrix().T), _EXACT[self.precision]
        packed = (_packed(matrix, width, precision, self.unit) for width in WIDTHS)
        return dataclasses.replace(
            min(packed, key=lambda tiles: tiles.nbytes), difference=self.difference
        )


def pack(matrix: Any, width: int = 8, precision: str = "float16") -> Packed:
    """A sparse matrix in tiles; parameters and refusals are those of `ltcl.operators.Tiles`."""
    matrix = _nonzeros(matrix)
    checks.one_of("precision", precision, PRECISIONS)
    if width not in WIDTHS:
        raise InputError(f"width is {width!r}; it must be one of {', '.join(map(str, WIDTHS))}")
    return _packed(matrix, width, precision)


def smallest(matrix: Any, tolerance: float) -> Packed:
    """A sparse matrix in the tiles of fewest bytes.

    Rounding changes it by `tolerance` of its Frobenius norm at most, or to float32.

    >>> packed = smallest(scipy.sparse.csr_array(np.full((4, 32), 0.75)), 0.01)
    >>> packed.width, packed.precision
    (8, 'int8')
    """
    matrix = _nonzeros(matrix)
    most = checks.number("tolerance", tolerance, least=0) * float(np.linalg.norm(matrix.data))
    all_kinds = (_packed(matrix, width, kind) for width in reversed(WIDTHS) for kind in PRECISIONS)
    allowed = (
        tiles for tiles in all_kinds if tiles.precision == "float32" or tiles.difference[0] <= most
    )
    return min(allowed, key=lambda tiles: tiles.nbytes)


class Tiles(RowOperator):
    """A sparse (M, N) matrix in tiles on the device.

    Parameters
    ----------
    matrix : scipy.sparse matrix or array, (M, N)
        Or what `pack` made of one. Refused as by `CSR`; InputError where a value is infinite in
        float32, too.
    width : 1 or 8
        Neighbouring columns of a tile; 1 is for scattered nonzeros.
    precision : str
        "float32", "float16" (11 significant bits) or "int8" (7, with a scale a tile).
        `quantisation` and `error` are the Frobenius norm of what rounding changed, and a bound on
        its 2-norm.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> from ltcl.operators import Tiles
    >>> A = Tiles(
    ...     ltcl.open_device(), scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.01]]), 1, "float16"
    ... )
    >>> (A @ numpy.array([1.0, 1.0])).tolist(), round(A.quantisation, 4)
    ([3.0, 3.009765625], 0.0002)
    """

    file = "tile"

    def __init__(
        self, device: Device, matrix: Any, width: int = 8, precision: str = "float16"
    ) -> None:
        self.packed = packed = (
            matrix if isinstance(matrix, Packed) else pack(matrix, width, precision)
        )
        super().__init__(device, packed.shape)
        device.require(packed.nbytes, f"a matrix of {packed.codes.size} numbers in tiles")
        self.quantisation, self.error = packed.difference
        self.frobenius = float(np.linalg.norm(packed.decoded()))
        self.width, self.precision, self.unit = packed.width, packed.precision, packed.unit
        place = "ushort" if packed.columns.itemsize == 2 else "int"
        self.defines = {
            "WIDTH": self.width,
            "VALUES": list(PRECISIONS).index(self.precision),
            "PLACE": place,
        }
        size = packed.codes.itemsize
        tile_bytes = max(packed.width * size, packed.columns.itemsize)
        row_bytes = np.maximum(tile_bytes * np.diff(packed.pointers), 4)
        cuts = cut(device, row_bytes, "the matrix of tiles", size)
        self.slabs, upload = [], device.upload
        for start, stop in cuts:
            pointers = packed.pointers[start : stop + 1]
            tiles = slice(pointers[0], pointers[-1])
            columns, codes = (
                upload(array[tiles], array.dtype) for array in (packed.columns, packed.codes)
            )
            # Not read where there are none, but a kernel needs a buffer.
            scales = upload(packed.scales[tiles], np.uint8) if packed.scales.size else columns
            counts = upload(pointers - pointers[0], np.int32)
            self.slabs.append(Slab(start, stop - start, (counts, columns, codes, scales)))

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N) float64, exact."""
        return self.packed.matrix()

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """What it stands for, in one."""
        yield 0, self.matrix()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        packed = self.packed
        return {
            "shape": np.array(packed.shape, np.int64),
            "layout": np.array([packed.width, 1, 1, packed.columns.itemsize == 4], np.int64),
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
        """Of what `to_arrays` gave; what does not fit together is refused, and so are retired formats."""
        precision, layout = str(arrays["precision"]), [int(n) for n in arrays["layout"]]
        if precision not in PRECISIONS or layout[0] not in WIDTHS or layout[1:3] != [1, 1]:
            raise InputError(
                f"stored tiles have the layout {layout} in {precision}; it must be 1 or 8 columns in "
                f"{', '.join(PRECISIONS)}: compress again"
            )
        pointers, starts, codes, scales = (np.asarray(arrays[name]) for name in _ARRAYS)
        (rows, columns), (frobenius, bound) = arrays["shape"], arrays["difference"]
        shape, difference = (int(rows), int(columns)), (float(frobenius), float(bound))
        unit = float(arrays["unit"])
        packed = Packed(shape, pointers, starts, precision, codes, scales, unit, difference)
        _check(packed, layout[0])
        return cls(device, packed)

    def _transposed_rows(self) -> Tiles:
        return Tiles(self.device, self.packed.transposed())


def _packed(matrix: Any, width: int, precision: str, unit: float | None = None) -> Packed:
    rows, columns = matrix.shape
    width = max(w for w in WIDTHS if w <= max(min(width, columns), 1))
    leads = _leads(matrix, width)
    tile = np.cumsum(leads) - 1  # of each nonzero
    first = np.minimum(matrix.indices[leads], max(columns - width, 0))
    counts = np.concatenate([[0], np.cumsum(leads)])[matrix.indptr]
    places = tile, matrix.indices - first[tile]
    numbers = np.zeros((len(first), width))
    numbers[places] = matrix.data
    codes, scales, unit = quantize(numbers, precision, unit)
    starts = first.astype(np.uint16 if columns <= 1 << 16 else np.int32)
    counts = counts.astype(np.int64)
    packed = Packed(matrix.shape, counts, starts, precision, codes, scales, unit, (0.0, 0.0))
    lost = np.abs(matrix.data - packed.decoded()[places])
    frobenius, row = float(np.linalg.norm(lost)), np.repeat(np.arange(rows), np.diff(matrix.indptr))
    one, inf = (float(np.bincount(at, lost).max(initial=0.0)) for at in (matrix.indices, row))
    return dataclasses.replace(packed, difference=(frobenius, min(frobenius, (one * inf) ** 0.5)))


def _leads(matrix: Any, width: int) -> np.ndarray:
    """Which nonzeros open a tile, (nnz,)."""
    counts = np.diff(matrix.indptr)
    line = np.repeat(
        np.arange(len(counts)) * (matrix.shape[1] + width), counts
    )  # rows one behind the other
    line += matrix.indices
    behind = np.searchsorted(
        line, line + width
    )  # the first nonzero that the tile of each does not hold
    leads = np.zeros(len(line), bool)
    at, stop = matrix.indptr[:-1][counts > 0], matrix.indptr[1:][counts > 0]
    while at.size:  # a tile further in all rows
        leads[at] = True
        at = behind[at]
        left = at < stop
        at, stop = at[left], stop[left]
    return leads


def quantize(
    numbers: np.ndarray, precision: str, unit: float | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Codes, scales and unit of the numbers of tiles, (tiles, width); `unit` of numbers quantized before."""
    codes, none = (
        rounded(numbers, np.float32),
        np.zeros(0, np.uint8),
    )  # refuses what float32 cannot hold
    if precision == "float32":
        return codes, none, 1.0
    if (
        unit is None
    ):  # the power of two, in the range of float32, in which the largest is in 2^14 .. 2^15
        largest = float(np.max(np.abs(numbers), initial=0.0))
        unit = 2.0 ** max(int(np.frexp(largest)[1]) - 15, -126) if largest > 0 else 1.0
    numbers = numbers / unit
    if (
        precision == "int8"
    ):  # with the smallest scale of each tile that lets no code pass 127, at least 2^-14
        fraction, exponent = np.frexp(np.abs(numbers).max(axis=1, initial=0.0) / 127)  # in 1/2 .. 1
        bits = (exponent + 14) * 8 + np.ceil(16 * fraction - 8).astype(np.int64)
        scales = np.where(fraction > 0, np.maximum(bits, 8), 8).astype(np.uint8)
        return np.rint(numbers / _scale(scales)[:, None]).astype(np.int8), scales, unit
    sizes = np.abs(numbers)
    least = np.where(sizes < _LEAST / 2, 0.0, np.copysign(_LEAST, numbers))
    return np.where(sizes < _LEAST, least, numbers).astype(np.float16), none, unit


def _scale(bits: np.ndarray) -> np.ndarray:
    return np.ldexp(1 + (bits & 7) / 8, (bits >> 3).astype(np.int32) - 15)


def _nonzeros(matrix: Any) -> scipy.sparse.csr_array:
    """A checked `csr_array` without stored zeros, which would claim tiles."""
    checked = checks.csr("matrix", matrix)
    if not np.all(checked.data):
        checked = checked.copy()
        checked.eliminate_zeros()
    return checked


def _check(packed: Packed, width: int) -> None:
    """Refuse arrays that a kernel could read beyond, of other types than it reads, or not finite."""
    (rows, count), pointers, columns = packed.shape, packed.pointers, packed.columns
    codes, scales, tiles = packed.codes, packed.scales, len(columns)
    facts = {
        "layout": width <= max(count, 1),
        "starts": columns.dtype == (np.uint16 if count <= 1 << 16 else np.int32)
        and columns.ndim == 1,
        "codes": codes.dtype == PRECISIONS[packed.precision] and codes.shape == (tiles, width),
        "scales": scales.dtype == np.uint8
        and scales.shape == (tiles if packed.precision == "int8" else 0,),
        "pointers": pointers.dtype == np.int64
        and pointers.shape == (rows + 1,)
        and (pointers[0], pointers[-1]) == (0, tiles)
        and np.all(np.diff(pointers) >= 0),
        "unit, difference": np.all(np.isfinite([packed.unit, *packed.difference])),
    }
    bad = [name for name, fits in facts.items() if not fits]
    if bad:
        raise InputError(
            f"{', '.join(bad)} of stored tiles do not fit; they must be what to_arrays gave"
        )
    checks.finite("the numbers of stored tiles", packed.decoded())
    if tiles and (columns.min() < 0 or columns.max() > max(count - width, 0)):
        raise InputError(
            "a stored tile reaches beyond the matrix; starts must be what to_arrays gave"
        )
