# SPDX-License-Identifier: BSD-3-Clause
"""A sparse matrix as rows of tiles of narrow numbers: what a device gets and what a file keeps."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError
from ltcl.operators.covers import PLACES, WIDTHS, Cover, Layout, cover
from ltcl.operators.narrow import PRECISIONS, Narrow, decoded, narrow, scaled_rows


class Difference(NamedTuple):
    """Of two matrices: its Frobenius norm, and a bound on its 2-norm."""

    frobenius: float
    bound: float


@dataclass(frozen=True, eq=False)
class Packed:
    """A matrix in tiles; made by `pack`.

    Attributes
    ----------
    shape : (M, N)
    precision : str
        Of the numbers; see `ltcl.operators.narrow`.
    layout : Layout
    pointers : (M * pages + 1,) int64
        First tile of each page of each row.
    starts : (tiles,)
        Place of each tile in its page.
    values : (tiles, width)
        Codes of its numbers, zeros where no nonzero is.
    unit, scales : float, (M,) or (0,) float32
        What codes are to be multiplied by; no scales stand for ones.
    difference : Difference
        From the matrix that was given.
    """

    shape: tuple[int, int]
    precision: str
    layout: Layout
    pointers: np.ndarray
    starts: np.ndarray
    values: np.ndarray
    unit: float
    scales: np.ndarray
    difference: Difference

    @property
    def nbytes(self) -> int:
        """Bytes of it, with 32-bit pointers as the device has them."""
        tiles = self.layout.nbytes(self.shape[0], len(self.starts))
        return tiles + self.values.nbytes + self.scales.nbytes

    def numbers(self) -> scipy.sparse.csr_array:
        """The codes as numbers, without unit and scales: (M, N) float64, exact."""
        page = np.repeat(np.arange(len(self.pointers) - 1), np.diff(self.pointers))
        row, page = np.divmod(page, self.layout.pages)
        columns = (page * PLACES + self.starts) * self.layout.granule
        columns = np.minimum(columns, self.layout.last(self.shape[1]))
        tile, lane = np.nonzero(self.values)
        data = PRECISIONS[self.precision].decode(self.values[tile, lane])
        return scipy.sparse.csr_array((data, (row[tile], columns[tile] + lane)), shape=self.shape)

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N) float64, exact."""
        matrix = self.numbers()
        matrix.data = scaled_rows(matrix.data * self.unit, matrix.indptr, self.scales)
        return matrix

    def transposed(self) -> Packed:
        """The same numbers transposed, without the scales, in tiles of the width that takes fewest bytes."""
        turned = scipy.sparse.csr_array(self.numbers().T)
        codes = PRECISIONS[self.precision].encode(turned.data)
        covers = [cover(turned, width) for width in WIDTHS]
        return _filled(
            turned,
            min(covers, key=lambda found: found.nbytes(codes.itemsize)),
            self.precision,
            Narrow(codes, self.unit, np.zeros(0, np.float32)),
            self.difference,
        )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return {
            "shape": np.array(self.shape, np.int64),
            "precision": np.array(self.precision),
            "layout": np.array(dataclasses.astuple(self.layout), np.int64),
            "pointers": self.pointers,
            "starts": self.starts,
            "values": self.values,
            "unit": np.array(self.unit),
            "scales": self.scales,
            "difference": np.array(self.difference),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Packed:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        width, granule, pages, long = (int(n) for n in arrays["layout"])
        packed = cls(
            (int(arrays["shape"][0]), int(arrays["shape"][1])),
            str(arrays["precision"]),
            Layout(width, granule, pages, bool(long)),
            np.asarray(arrays["pointers"]),
            np.asarray(arrays["starts"]),
            np.asarray(arrays["values"]),
            float(arrays["unit"]),
            np.asarray(arrays["scales"]),
            Difference(*(float(n) for n in arrays["difference"])),
        )
        _check(packed)
        return packed


def pack(matrix: Any, width: int = 8, precision: str = "bfloat16") -> Packed:
    """A sparse matrix in tiles; parameters and refusals are those of `ltcl.operators.Tiles`.

    >>> packed = pack(scipy.sparse.csr_array([[0.0, 0.5, 3.0]]), width=1)
    >>> packed.matrix().toarray().tolist(), packed.nbytes, packed.difference.frobenius
    ([[0.0, 0.5, 3.0]], 16, 0.0)
    """
    matrix = given(matrix)
    checks.one_of("precision", precision, PRECISIONS)
    found = cover(matrix, width)
    stored = narrow(matrix.data, matrix.indptr, precision)
    return _filled(matrix, found, precision, stored, difference(matrix, stored, precision))


def given(matrix: Any) -> scipy.sparse.csr_array:
    """A matrix as users hold it, sparse or dense, as a checked `csr_array`."""
    if scipy.sparse.issparse(matrix):
        return checks.csr("matrix", matrix)
    dense = checks.finite("matrix", checks.real("matrix", matrix))
    if dense.ndim != 2:
        raise InputError(f"matrix has shape {dense.shape}; it must be (M, N)")
    return checks.csr("matrix", scipy.sparse.csr_array(dense))


def difference(matrix: Any, stored: Narrow, precision: str) -> Difference:
    """Between a `csr_array` and its numbers as they are stored."""
    data = np.abs(matrix.data - decoded(stored, matrix.indptr, precision))
    lost = scipy.sparse.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)
    frobenius = float(np.linalg.norm(data))
    one, inf = (float(np.max(lost.sum(axis=axis), initial=0.0)) for axis in (0, 1))
    return Difference(frobenius, min(frobenius, (one * inf) ** 0.5))


def _filled(matrix: Any, found: Cover, precision: str, stored: Narrow, lost: Difference) -> Packed:
    """The tiles of a cover with the codes of the nonzeros in them."""
    layout = found.layout
    page, places = (
        np.divmod(-(-found.columns // layout.granule), PLACES) if not layout.long else (0, found.columns)
    )
    values = np.zeros((len(found.columns), layout.width), stored.codes.dtype)
    values[found.tile, matrix.indices - found.columns[found.tile]] = stored.codes
    counts = np.bincount(found.rows * layout.pages + page, minlength=matrix.shape[0] * layout.pages)
    return Packed(
        matrix.shape,
        precision,
        layout,
        np.concatenate([[0], np.cumsum(counts)]),
        places.astype(layout.place),
        values,
        stored.unit,
        stored.scales,
        lost,
    )


def _check(packed: Packed) -> None:
    """Refuse arrays that a kernel could read beyond, of other types than it reads, or not finite."""
    layout, (rows, columns) = packed.layout, packed.shape
    tiles, kind = len(packed.starts), PRECISIONS[checks.one_of("precision", packed.precision, PRECISIONS)]
    pointers, starts, values, scales = packed.pointers, packed.starts, packed.values, packed.scales
    wanted = {
        "width": layout.width in WIDTHS and layout.width <= max(columns, 1),
        "granule": 1 <= layout.granule <= layout.width,
        "pages": layout.pages >= 1,
        "starts": starts.dtype == layout.place and starts.ndim == 1 and np.all(starts >= 0),
        "values": values.dtype == kind.dtype and values.shape == (tiles, layout.width),
        "scales": scales.dtype == np.float32 and scales.shape in ((0,), (rows,)),
        "pointers": pointers.dtype == np.int64
        and pointers.shape == (rows * layout.pages + 1,)
        and (pointers[0], pointers[-1]) == (0, tiles)
        and np.all(np.diff(pointers) >= 0),
        "numbers": np.all(np.isfinite([packed.unit, *packed.difference])) and np.all(np.isfinite(scales)),
    }
    bad = [name for name, fits in wanted.items() if not fits]
    if bad:
        raise InputError(f"{', '.join(bad)} of stored tiles do not fit; they must be what to_arrays gave")
    checks.finite("values of stored tiles", kind.decode(values))


def smallest(matrix: Any, tolerance: float) -> tuple[int, str]:
    """Width and precision of the tiles that take fewest bytes, nothing of which is built.

    Parameters
    ----------
    matrix : as `ltcl.operators.Tiles` takes
    tolerance : float
        Most that rounding may change the matrix by, as a part of its Frobenius norm; where nothing else will
        do, the answer is float32.

    >>> smallest(scipy.sparse.csr_array(np.full((4, 32), 0.75)), 0.01)
    (16, 'int8')
    """
    matrix = given(matrix)
    most = checks.number("tolerance", tolerance, least=0) * float(np.linalg.norm(matrix.data))
    covers = {width: cover(matrix, width) for width in reversed(WIDTHS)}
    sizes = {}
    for name, kind in PRECISIONS.items():
        stored = narrow(matrix.data, matrix.indptr, name)
        if name == "float32" or difference(matrix, stored, name).frobenius <= most:
            for width, found in covers.items():
                sizes[width, name] = found.nbytes(np.dtype(kind.dtype).itemsize) + stored.scales.nbytes
    return min(sizes, key=sizes.__getitem__)
