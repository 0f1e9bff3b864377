# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices packed into tiles of narrow numbers, on the host.

A tile is 1 or 8 neighbouring columns of a row under one column index, of 16 bits where that
suffices: entries take 1.4 to 6 bytes, in compressed sparse rows 8. Tiles are laid greedily from
left to right, each beginning at the first nonzero that none before holds: there is no layout of
fewer. Numbers are rounded to nearest, a = unit * scale of the tile * code. `unit`, a power of two,
brings the largest near 2^15: subnormal numbers, which are left out since some devices take them for
zeros, are below 2^-28 of the largest. Codes of int8 share a scale of 5 bits of exponent and 3 of
fraction: float16 holds such a number exactly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device.arrays import rounded
from ltcl.errors import InputError

WIDTHS = (1, 8)
# In the order of VALUES in kernels/tile.cl.
PRECISIONS: dict[str, Any] = {"float32": np.float32, "float16": np.float16, "int8": np.int8}
# The precision that holds the numbers of each without scales.
PRECISION_WITHOUT_SCALES = {"float32": "float32", "float16": "float16", "int8": "float16"}
# The smallest float16 that is not subnormal.
MIN_NORMAL_FLOAT16 = 2.0**-14
MAX_INT8_CODE = 127
# Bits of the smallest scale, 2^-14.
SMALLEST_SCALE_BITS = 8


@dataclass(frozen=True, eq=False, kw_only=True)
class Packed:
    """A matrix in tiles; made by `pack`.

    Attributes
    ----------
    shape : (M, N)
    pointers : (M + 1,) int64
        The first tile of each row.
    columns : (tiles,) uint16 or int32
        The first column of each tile; no tile reaches beyond the matrix.
    precision : str
    codes : (tiles, width)
        Zeros beside the nonzeros.
    scales : (tiles,) uint8 for int8, else (0,)
    unit : float
    difference : (float, float)
        From the matrix that was packed: the Frobenius norm, and a bound on the 2-norm.
    """

    shape: tuple[int, int]
    pointers: np.ndarray
    columns: np.ndarray
    precision: str
    codes: np.ndarray
    scales: np.ndarray
    unit: float
    difference: tuple[float, float]

    @property
    def width(self) -> int:
        """Columns of a tile."""
        return self.codes.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes, with 32-bit pointers as the device has them."""
        arrays = self.columns.nbytes + self.codes.nbytes + self.scales.nbytes
        return 4 * len(self.pointers) + arrays

    def decoded(self) -> np.ndarray:
        """The numbers of the codes, (tiles, width) float64."""
        numbers = self.codes.astype(np.float64) * self.unit
        if not self.scales.size:
            return numbers
        return numbers * _scale_of_bits(self.scales)[:, None]

    def matrix(self) -> scipy.sparse.csr_array:
        """The matrix (M, N) that the tiles hold, float64, exact."""
        tile, lane = np.nonzero(self.codes)
        row_of_tile = np.repeat(np.arange(self.shape[0]), np.diff(self.pointers))
        columns = self.columns[tile].astype(np.int64) + lane
        values = self.decoded()[tile, lane]
        return scipy.sparse.csr_array((values, (row_of_tile[tile], columns)), shape=self.shape)

    def transposed(self) -> Packed:
        """The same numbers transposed, without scales, in tiles of the width of fewest bytes."""
        matrix = scipy.sparse.csr_array(self.matrix().T)
        precision = PRECISION_WITHOUT_SCALES[self.precision]
        candidates = [_pack(matrix, width, precision, self.unit) for width in WIDTHS]
        best = min(candidates, key=lambda packed: packed.nbytes)
        return dataclasses.replace(best, difference=self.difference)


def pack(matrix: Any, width: int = 8, precision: str = "float16") -> Packed:
    """A sparse matrix in tiles; parameters and refusals are those of `ltcl.operators.Tiles`."""
    matrix = _nonzeros(matrix)
    checks.one_of("precision", precision, PRECISIONS)
    if width not in WIDTHS:
        raise InputError(f"width is {width!r}; it must be one of {', '.join(map(str, WIDTHS))}")
    return _pack(matrix, width, precision)


def smallest(matrix: Any, tolerance: float) -> Packed:
    """A sparse matrix in the tiles of fewest bytes.

    Rounding changes it by `tolerance` of its Frobenius norm at most, or to float32.

    >>> packed = smallest(scipy.sparse.csr_array(np.full((4, 32), 0.75)), 0.01)
    >>> packed.width, packed.precision
    (8, 'int8')
    """
    matrix = _nonzeros(matrix)
    relative = checks.number("tolerance", tolerance, least=0)
    max_difference = relative * float(np.linalg.norm(matrix.data))
    best: Packed | None = None
    for width in reversed(WIDTHS):
        for precision in PRECISIONS:
            packed = _pack(matrix, width, precision)
            is_allowed = precision == "float32" or packed.difference[0] <= max_difference
            if is_allowed and (best is None or packed.nbytes < best.nbytes):
                best = packed
    assert best is not None  # noqa: S101 - float32 is always allowed
    return best


def joined_diagonally(blocks: Sequence[Packed]) -> Packed:
    """diag(A_1, ...) of matrices in tiles.

    Numbers stay as they are, but for those that float32 does not tell from 0 beside the largest.

    >>> eye = pack(scipy.sparse.eye_array(2, format="csr"), 1)
    >>> joined = joined_diagonally([eye, eye])
    >>> joined.matrix().toarray().tolist() == np.eye(4).tolist()
    True
    """
    first = blocks[0]
    unit = max(packed.unit for packed in blocks)
    differences = [packed.difference[0] for packed in blocks]
    frobenius = float(np.linalg.norm(differences))
    difference = (frobenius, max(packed.difference[1] for packed in blocks))
    formats = {(packed.width, packed.precision) for packed in blocks}
    scaled = [_in_unit(packed, unit) for packed in blocks]
    if len(formats) > 1 or any(codes is None for codes in scaled):
        return _packed_anew(blocks, unit, difference)
    height = 0
    width = 0
    codes = []
    scales = []
    columns = []
    pointers = [np.zeros(1, np.int64)]
    tile_count = 0
    for packed, in_unit in zip(blocks, scaled, strict=True):
        assert in_unit is not None  # noqa: S101 - as was seen above
        codes.append(in_unit[0])
        scales.append(in_unit[1])
        columns.append(packed.columns.astype(np.int64) + width)
        pointers.append(packed.pointers[1:] + tile_count)
        tile_count += len(packed.columns)
        height += packed.shape[0]
        width += packed.shape[1]
    return Packed(
        shape=(height, width),
        pointers=np.concatenate(pointers),
        columns=np.concatenate(columns).astype(_column_type(width)),
        precision=first.precision,
        codes=np.concatenate(codes),
        scales=np.concatenate(scales),
        unit=unit,
        difference=difference,
    )


def _packed_anew(blocks: Sequence[Packed], unit: float, difference: tuple[float, float]) -> Packed:
    """The same in the narrowest tiles of the blocks, and without scales."""
    matrices: list[Any] = []
    width = blocks[0].width
    precision = "float16"
    common_unit: float | None = unit
    for packed in blocks:
        matrices.append(packed.matrix())
        width = min(width, packed.width)
        if PRECISION_WITHOUT_SCALES[packed.precision] == "float32":
            precision = "float32"
            common_unit = None
    matrix = scipy.sparse.csr_array(scipy.sparse.block_diag(matrices, format="csr"))
    joined = _pack(_nonzeros(matrix), width, precision, common_unit)
    return dataclasses.replace(joined, difference=difference)


def _in_unit(packed: Packed, unit: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Codes and scales of the same numbers in a larger unit; None where that is out of range.

    Units are powers of two.
    """
    ratio = packed.unit / unit
    if ratio == 1.0:
        return packed.codes, packed.scales
    if packed.precision == "int8":
        # Three bits of a scale are its fraction.
        scales = packed.scales.astype(int) + 8 * round(np.log2(ratio))
        if np.min(scales, initial=SMALLEST_SCALE_BITS) < SMALLEST_SCALE_BITS:
            return None
        return packed.codes, scales.astype(np.uint8)
    codes = packed.codes * packed.codes.dtype.type(ratio)
    # Subnormal numbers are below what float32 tells from 0 beside the largest.
    is_subnormal = np.abs(codes) < np.finfo(codes.dtype).tiny
    return np.where(is_subnormal, codes.dtype.type(0), codes), packed.scales


def _pack(matrix: Any, width: int, precision: str, unit: float | None = None) -> Packed:
    columns = matrix.shape[1]
    width = max(w for w in WIDTHS if w <= max(min(width, columns), 1))
    leads = _tile_leads(matrix, width)
    tile_of_nonzero = np.cumsum(leads) - 1
    last_start = max(columns - width, 0)
    starts = np.minimum(matrix.indices[leads], last_start)
    lanes = matrix.indices - starts[tile_of_nonzero]
    numbers = np.zeros((len(starts), width))
    numbers[tile_of_nonzero, lanes] = matrix.data
    codes, scales, unit = quantize(numbers, precision, unit)
    tiles_before = np.concatenate([[0], np.cumsum(leads)])
    packed = Packed(
        shape=matrix.shape,
        pointers=tiles_before[matrix.indptr].astype(np.int64),
        columns=starts.astype(_column_type(columns)),
        precision=precision,
        codes=codes,
        scales=scales,
        unit=unit,
        difference=(0.0, 0.0),
    )
    changes = np.abs(matrix.data - packed.decoded()[tile_of_nonzero, lanes])
    return dataclasses.replace(packed, difference=_norms_of_changes(matrix, changes))


def _column_type(columns: int) -> Any:
    """The type of column indices: 16 bits if they suffice."""
    return np.uint16 if columns <= 1 << 16 else np.int32


def _norms_of_changes(matrix: Any, changes: np.ndarray) -> tuple[float, float]:
    """The Frobenius norm of changes of the nonzeros, and a bound on their 2-norm."""
    frobenius = float(np.linalg.norm(changes))
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    column_sums = np.bincount(matrix.indices, changes)
    row_sums = np.bincount(row, changes)
    one_norm = float(column_sums.max(initial=0.0))
    inf_norm = float(row_sums.max(initial=0.0))
    return frobenius, min(frobenius, (one_norm * inf_norm) ** 0.5)


def _tile_leads(matrix: Any, width: int) -> np.ndarray:
    """True for each nonzero that opens a tile, (nnz,) bool."""
    counts = np.diff(matrix.indptr)
    # Rows one behind the other, too far apart for a tile to reach the next.
    row_starts = np.arange(len(counts)) * (matrix.shape[1] + width)
    line = np.repeat(row_starts, counts) + matrix.indices
    # The first nonzero that a tile from each one does not hold.
    following = np.searchsorted(line, line + width)
    leads = np.zeros(len(line), bool)
    position = matrix.indptr[:-1][counts > 0]
    stop = matrix.indptr[1:][counts > 0]
    # One tile further in all rows at once.
    while position.size:
        leads[position] = True
        position = following[position]
        is_within = position < stop
        position = position[is_within]
        stop = stop[is_within]
    return leads


def quantize(
    numbers: np.ndarray, precision: str, unit: float | None = None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Codes, scales and unit of the numbers of tiles, (tiles, width).

    `unit` is that of numbers that were quantized before.
    """
    # Numbers that float32 cannot hold are refused.
    single = rounded(numbers, np.float32)
    no_scales = np.zeros(0, np.uint8)
    if precision == "float32":
        return single, no_scales, 1.0
    if unit is None:
        unit = _unit(numbers)
    numbers = numbers / unit
    if precision == "int8":
        scales = _scale_bits(numbers)
        codes = np.rint(numbers / _scale_of_bits(scales)[:, None])
        return codes.astype(np.int8), scales, unit
    sizes = np.abs(numbers)
    # Subnormal numbers are rounded to 0 or to the smallest normal one.
    smallest_normal = np.copysign(MIN_NORMAL_FLOAT16, numbers)
    nearest = np.where(sizes < MIN_NORMAL_FLOAT16 / 2, 0.0, smallest_normal)
    codes = np.where(sizes < MIN_NORMAL_FLOAT16, nearest, numbers)
    return codes.astype(np.float16), no_scales, unit


def _unit(numbers: np.ndarray) -> float:
    """The power of two, in the range of float32, that brings the largest number to 2^14 .. 2^15."""
    largest = float(np.max(np.abs(numbers), initial=0.0))
    if largest == 0.0:
        return 1.0
    exponent = int(np.frexp(largest)[1])
    return 2.0 ** max(exponent - 15, -126)


def _scale_bits(numbers: np.ndarray) -> np.ndarray:
    """The smallest scale of each tile, from 2^-14, that lets no code pass 127, (tiles,) uint8."""
    largest = np.abs(numbers).max(axis=1, initial=0.0)
    fraction, exponent = np.frexp(largest / MAX_INT8_CODE)
    # Fractions are in 1/2 .. 1.
    bits = (exponent + 14) * 8 + np.ceil(16 * fraction - 8).astype(np.int64)
    bits = np.maximum(bits, SMALLEST_SCALE_BITS)
    return np.where(fraction > 0, bits, SMALLEST_SCALE_BITS).astype(np.uint8)


def _scale_of_bits(bits: np.ndarray) -> np.ndarray:
    """The scale of 5 bits of exponent and 3 of fraction."""
    return np.ldexp(1 + (bits & 7) / 8, (bits >> 3).astype(np.int32) - 15)


def _nonzeros(matrix: Any) -> scipy.sparse.csr_array:
    """A checked `csr_array` without stored zeros, which would claim tiles."""
    checked = checks.csr("matrix", matrix)
    if not np.all(checked.data):
        checked = checked.copy()
        checked.eliminate_zeros()
    return checked


def check_packed(packed: Packed, width: int) -> None:
    """Refuse arrays of wrong sizes, which a kernel would read beyond, or types, or not finite."""
    rows, columns = packed.shape
    tiles = len(packed.columns)
    scale_count = tiles if packed.precision == "int8" else 0
    numbers = [packed.unit, *packed.difference]
    fits = {
        "layout": width <= max(columns, 1),
        "starts": packed.columns.dtype == _column_type(columns) and packed.columns.ndim == 1,
        "codes": packed.codes.dtype == PRECISIONS[packed.precision]
        and packed.codes.shape == (tiles, width),
        "scales": packed.scales.dtype == np.uint8 and packed.scales.shape == (scale_count,),
        "pointers": _are_pointers(packed.pointers, rows, tiles),
        "unit, difference": np.all(np.isfinite(numbers)),
    }
    bad = [name for name, does_fit in fits.items() if not does_fit]
    if bad:
        raise InputError(
            f"{', '.join(bad)} of stored tiles do not fit; they must be as to_arrays gave them"
        )
    checks.finite("the numbers of stored tiles", packed.decoded())
    last_start = max(columns - width, 0)
    if tiles and (packed.columns.min() < 0 or packed.columns.max() > last_start):
        raise InputError(
            "a stored tile reaches beyond the matrix; starts must be as to_arrays gave them"
        )


def _are_pointers(pointers: np.ndarray, rows: int, tiles: int) -> bool:
    """True if they are (rows + 1,) int64 from 0 to `tiles`, ascending."""
    if pointers.dtype != np.int64 or pointers.shape != (rows + 1,):
        return False
    reaches_all = pointers[0] == 0 and pointers[-1] == tiles
    return bool(reaches_all and np.all(np.diff(pointers) >= 0))
