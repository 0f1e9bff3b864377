# SPDX-License-Identifier: BSD-3-Clause
"""A sparse matrix as rows of tiles of few bits: what a device gets and what a file keeps.

A tile is `width` neighbouring columns of a row under one column index, of 16 bits where the matrix has no
more columns than that. Tiles are laid greedily from left to right, each beginning at the first nonzero that
none before holds: there is no layout of fewer. Its numbers are rounded to nearest,

    a = unit * scale of the tile * code

float32 stands as it is. The others share one power of two, `unit`, that brings the largest number near the
top of float16: nothing overflows, and what is left out for want of subnormal numbers, which some devices take
for zeros, is below 2^-28 of the largest. Codes of int8 share a scale in a tile, of 5 bits of exponent and 3
of fraction. One a row would take fewer bytes, but a row of wavelet coefficients of a transport spans too
much: rounding lost 5 times as much. Such a number has 11 significant bits at most: float16 holds it exactly.
bfloat16 is left out: as many bytes as float16 at 8 times its error. So are tiles of 16: no fewer bytes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device.array import rounded
from ltcl.errors import InputError

WIDTHS = (1, 8)
# In the order of VALUES in kernels/common/tile_sums.h.
PRECISIONS: dict[str, Any] = {"float32": np.float32, "float16": np.float16, "int8": np.int8}
_EXACT = {"float32": "float32", "float16": "float16", "int8": "float16"}  # holds its numbers without scales
_LEAST = 2.0**-14  # of float16 that is not subnormal
_ARRAYS = ("pointers", "starts", "codes", "scales")
_STORED = ("shape", "layout", "precision", "unit", "difference", *_ARRAYS)


@dataclass(frozen=True, eq=False)
class Packed:
    """A matrix in tiles; made by `pack`.

    `difference` is that from the matrix that was packed: its Frobenius norm, and a bound on its 2-norm.
    """

    shape: tuple[int, int]  # (M, N)
    pointers: np.ndarray  # (M + 1,) int64, the first tile of each row
    columns: np.ndarray  # (tiles,) uint16 or int32, the first of each; none reaches beyond the matrix
    precision: str
    codes: np.ndarray  # (tiles, width), zeros where no nonzero is
    scales: np.ndarray  # (tiles,) uint8 of int8, else (0,)
    unit: float
    difference: tuple[float, float]

    @property
    def width(self) -> int:
        """Neighbouring columns of a tile; fewer than asked for where the matrix has not so many."""
        return self.codes.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes of it, with 32-bit pointers as the device has them."""
        return 4 * len(self.pointers) + self.columns.nbytes + self.codes.nbytes + self.scales.nbytes

    def decoded(self) -> np.ndarray:
        """The numbers that codes stand for, (tiles, width) float64."""
        return _decoded(self.codes, self.scales, self.unit)

    def frobenius(self) -> float:
        """Frobenius norm of the numbers, without a copy of them."""
        squares = np.einsum("ij,ij->i", self.codes, self.codes, dtype=np.float64)
        if self.scales.size:
            squares *= _scale(self.scales) ** 2
        return self.unit * float(np.sqrt(np.sum(squares)))

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
        return dataclasses.replace(min(packed, key=lambda one: one.nbytes), difference=self.difference)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return {
            "shape": np.array(self.shape, np.int64),
            "layout": np.array([self.width, 1, 1, self.columns.itemsize == 4], np.int64),
            "pointers": self.pointers,
            "starts": self.columns,
            "precision": np.array(self.precision),
            "codes": self.codes,
            "scales": self.scales,
            "unit": np.array(self.unit),
            "difference": np.array(self.difference),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Packed:
        """Of what `to_arrays` gave; what does not fit together is refused, and so are retired formats."""
        lacking = [name for name in _STORED if name not in arrays]
        if lacking:
            raise InputError(f"stored tiles lack {', '.join(lacking)}; they must be what to_arrays gave")
        precision, (width, granule, pages, _) = str(arrays["precision"]), (int(n) for n in arrays["layout"])
        if precision == "bfloat16" or width == 16 or (granule, pages) != (1, 1):
            raise InputError(f"stored tiles are of {width} columns in {precision}, retired: compress again")
        checks.one_of("precision", precision, PRECISIONS)
        pointers, starts, codes, scales = (np.asarray(arrays[name]) for name in _ARRAYS)
        (rows, columns), (frobenius, bound) = arrays["shape"], arrays["difference"]
        shape, difference = (int(rows), int(columns)), (float(frobenius), float(bound))
        unit = float(arrays["unit"])
        packed = cls(shape, pointers, starts, precision, codes, scales, unit, difference)
        _check(packed, width)
        return packed


def pack(matrix: Any, width: int = 8, precision: str = "float16") -> Packed:
    """A sparse matrix in tiles; parameters and refusals are those of `ltcl.operators.Tiles`.

    >>> packed = pack(scipy.sparse.csr_array([[0.0, 0.5, 3.0]]), width=1)
    >>> packed.matrix().toarray().tolist(), packed.nbytes, packed.difference[0]
    ([[0.0, 0.5, 3.0]], 16, 0.0)
    """
    matrix = _nonzeros(matrix)
    checks.one_of("precision", precision, PRECISIONS)
    if width not in WIDTHS:
        raise InputError(f"width is {width!r}; it must be one of {', '.join(map(str, WIDTHS))}")
    return _packed(matrix, width, precision)


def smallest(matrix: Any, tolerance: float) -> tuple[int, str]:
    """Width and precision of the tiles that take fewest bytes; nothing goes to a device.

    Parameters
    ----------
    matrix : as `ltcl.operators.Tiles` takes
    tolerance : float
        Most that rounding may change the matrix by, as a part of its Frobenius norm; where nothing else will
        do, the answer is float32.

    >>> smallest(scipy.sparse.csr_array(np.full((4, 32), 0.75)), 0.01)
    (8, 'int8')
    """
    matrix = _nonzeros(matrix)
    most = checks.number("tolerance", tolerance, least=0) * float(np.linalg.norm(matrix.data))
    sizes = {}
    for width in reversed(WIDTHS):
        for precision in PRECISIONS:
            packed = _packed(matrix, width, precision)
            if precision == "float32" or packed.difference[0] <= most:
                sizes[width, precision] = packed.nbytes
    return min(sizes, key=sizes.__getitem__)


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
    lost = np.abs(matrix.data - _decoded(codes, scales, unit)[places])
    frobenius, row = float(np.linalg.norm(lost)), np.repeat(np.arange(rows), np.diff(matrix.indptr))
    one, inf = (float(np.bincount(at, lost).max(initial=0.0)) for at in (matrix.indices, row))
    starts = first.astype(np.uint16 if columns <= 1 << 16 else np.int32)
    difference = frobenius, min(frobenius, (one * inf) ** 0.5)
    return Packed(matrix.shape, counts.astype(np.int64), starts, precision, codes, scales, unit, difference)


def _leads(matrix: Any, width: int) -> np.ndarray:
    """Which nonzeros open a tile, (nnz,)."""
    counts = np.diff(matrix.indptr)
    line = np.repeat(np.arange(len(counts)) * (matrix.shape[1] + width), counts)  # rows one behind the other
    line += matrix.indices
    behind = np.searchsorted(line, line + width)  # the first nonzero that the tile of each does not hold
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
    """Codes, scales and unit of the numbers of tiles, (tiles, width); `unit` of numbers quantized before.

    >>> [array.tolist() for array in quantize(np.array([[1.2, -127.0]]), "int8")[:2]]
    [[[1, -127]], [184]]
    """
    codes, none = rounded(numbers, np.float32), np.zeros(0, np.uint8)  # refuses what float32 cannot hold
    if precision == "float32":
        return codes, none, 1.0
    unit = _unit(float(np.max(np.abs(numbers), initial=0.0))) if unit is None else unit
    numbers = numbers / unit
    if precision == "int8":
        scales = _scales(numbers)
        return np.rint(numbers / _scale(scales)[:, None]).astype(np.int8), scales, unit
    sizes = np.abs(numbers)
    least = np.where(sizes < _LEAST / 2, 0.0, np.copysign(_LEAST, numbers))
    return np.where(sizes < _LEAST, least, numbers).astype(np.float16), none, unit


def _decoded(codes: np.ndarray, scales: np.ndarray, unit: float) -> np.ndarray:
    numbers = codes.astype(np.float64) * unit
    return numbers * _scale(scales)[:, None] if scales.size else numbers


def _scale(bits: np.ndarray) -> np.ndarray:
    return np.ldexp(1 + (bits & 7) / 8, (bits >> 3).astype(np.int32) - 15)


def _scales(numbers: np.ndarray) -> np.ndarray:
    """Bits of the smallest scale of each tile that lets no code pass 127; at least 2^-14."""
    fraction, exponent = np.frexp(np.abs(numbers).max(axis=1, initial=0.0) / 127)  # in 1/2 .. 1
    bits = (exponent + 14) * 8 + np.ceil(16 * fraction - 8).astype(np.int64)
    return np.where(fraction > 0, np.maximum(bits, 8), 8).astype(np.uint8)


def _unit(largest: float) -> float:
    """The power of two, in the range of float32, in which the largest number is between 2^14 and 2^15."""
    return 2.0 ** max(int(np.frexp(largest)[1]) - 15, -126) if largest > 0 else 1.0


def _nonzeros(matrix: Any) -> scipy.sparse.csr_array:
    """A matrix as users hold it, as a checked `csr_array` without stored zeros, which would claim tiles."""
    if not scipy.sparse.issparse(matrix):
        dense = checks.finite("matrix", checks.real("matrix", matrix))
        if dense.ndim != 2:
            raise InputError(f"matrix has shape {dense.shape}; it must be (M, N)")
        matrix = scipy.sparse.csr_array(dense)
    checked = checks.csr("matrix", matrix)
    if not np.all(checked.data):
        checked = checked.copy()
        checked.eliminate_zeros()
    return checked


def _check(packed: Packed, width: int) -> None:
    """Refuse arrays that a kernel could read beyond, of other types than it reads, or not finite."""
    (rows, count), pointers, columns = packed.shape, packed.pointers, packed.columns
    codes, scales, tiles = packed.codes, packed.scales, len(columns)
    wanted = {
        "layout": width in WIDTHS and width <= max(count, 1),
        "starts": columns.dtype == (np.uint16 if count <= 1 << 16 else np.int32) and columns.ndim == 1,
        "codes": codes.dtype == PRECISIONS[packed.precision] and codes.shape == (tiles, width),
        "scales": scales.dtype == np.uint8 and scales.shape == (tiles if packed.precision == "int8" else 0,),
        "pointers": pointers.dtype == np.int64
        and pointers.shape == (rows + 1,)
        and (pointers[0], pointers[-1]) == (0, tiles)
        and np.all(np.diff(pointers) >= 0),
        "unit, difference": np.all(np.isfinite([packed.unit, *packed.difference])),
    }
    bad = [name for name, fits in wanted.items() if not fits]
    if bad:
        raise InputError(f"{', '.join(bad)} of stored tiles do not fit; they must be what to_arrays gave")
    checks.finite("the numbers of stored tiles", packed.decoded())
    if tiles and (columns.min() < 0 or columns.max() > max(count - width, 0)):
        raise InputError("a stored tile reaches beyond the matrix; starts must be what to_arrays gave")
