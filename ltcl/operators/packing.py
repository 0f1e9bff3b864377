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
from ltcl.operators.narrow import PRECISIONS, Narrow, narrow

_STORED = ("shape", "layout", "pointers", "starts", "precision", "codes", "scales", "unit", "difference")


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
    layout : Layout
    pointers : (M * pages + 1,) int64
        First tile of each page of each row.
    starts : (tiles,)
        Place of each tile in its page.
    stored : Narrow
        The numbers of tiles, zeros where no nonzero is.
    difference : Difference
        From the matrix that was given.
    """

    shape: tuple[int, int]
    layout: Layout
    pointers: np.ndarray
    starts: np.ndarray
    stored: Narrow
    difference: Difference

    @property
    def nbytes(self) -> int:
        """Bytes of it, with 32-bit pointers as the device has them."""
        return self.layout.nbytes(self.shape[0], len(self.starts)) + self.stored.nbytes

    def columns(self) -> np.ndarray:
        """First column of each tile, (tiles,) int64."""
        page = np.repeat(np.arange(len(self.pointers) - 1), np.diff(self.pointers)) % self.layout.pages
        columns = (page * PLACES + self.starts) * self.layout.granule
        # Where places count single columns, kernels do not look whether a tile ends within the matrix.
        return columns if self.layout.granule == 1 else np.minimum(columns, self.layout.last(self.shape[1]))

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N) float64, exact."""
        tile, lane = np.nonzero(self.stored.codes)
        row = np.repeat(np.arange(len(self.pointers) - 1) // self.layout.pages, np.diff(self.pointers))
        data = self.stored.decoded()[tile, lane]
        return scipy.sparse.csr_array((data, (row[tile], self.columns()[tile] + lane)), shape=self.shape)

    def transposed(self) -> Packed:
        """The same numbers transposed, without scales, in tiles of the width that takes fewest bytes."""
        precision = PRECISIONS[self.stored.precision].exact
        turned = scipy.sparse.csr_array(self.matrix().T)
        size = np.dtype(PRECISIONS[precision].dtype).itemsize
        found = min((cover(turned, width) for width in WIDTHS), key=lambda found: found.nbytes(size))
        return _packed(found, narrow(_tiles(turned, found), precision, self.stored.unit), self.difference)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return {
            "shape": np.array(self.shape, np.int64),
            "layout": np.array(dataclasses.astuple(self.layout), np.int64),
            "pointers": self.pointers,
            "starts": self.starts,
            "precision": np.array(self.stored.precision),
            "codes": self.stored.codes,
            "scales": self.stored.scales,
            "unit": np.array(self.stored.unit),
            "difference": np.array(self.difference),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Packed:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        lacking = [name for name in _STORED if name not in arrays]
        if lacking:
            raise InputError(f"stored tiles lack {', '.join(lacking)}; they must be what to_arrays gave")
        precision = checks.one_of("precision", str(arrays["precision"]), PRECISIONS)
        width, granule, pages, long = (int(n) for n in arrays["layout"])
        codes, scales = np.asarray(arrays["codes"]), np.asarray(arrays["scales"])
        packed = cls(
            (int(arrays["shape"][0]), int(arrays["shape"][1])),
            Layout(width, granule, pages, bool(long)),
            np.asarray(arrays["pointers"]),
            np.asarray(arrays["starts"]),
            Narrow(precision, codes, scales, float(arrays["unit"])),
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
    stored = narrow(_tiles(matrix, found), precision)
    return _packed(found, stored, _difference(matrix, found, stored))


def smallest(matrix: Any, tolerance: float) -> tuple[int, str]:
    """Width and precision of the tiles that take fewest bytes; nothing goes to a device.

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
    sizes = {}
    for width in reversed(WIDTHS):
        found = cover(matrix, width)
        tiles = _tiles(matrix, found)
        for precision in PRECISIONS:
            stored = narrow(tiles, precision)
            if precision == "float32" or np.linalg.norm(tiles - stored.decoded()) <= most:
                sizes[width, precision] = found.layout.nbytes(matrix.shape[0], len(tiles)) + stored.nbytes
    return min(sizes, key=sizes.__getitem__)


def spread(kept: Any, matrix: Any, width: int) -> scipy.sparse.csr_array:
    """All that `matrix` has in the tiles that cover `kept`: what else lies in them costs nothing to keep.

    >>> kept = scipy.sparse.csr_array(([1.0], ([0], [2])), shape=(1, 20))
    >>> spread(kept, np.ones((1, 20)), 8).indices.tolist()
    [2, 3, 4, 5, 6, 7, 8, 9]
    """
    kept, matrix = given(kept), given(matrix)
    if kept.shape != matrix.shape:
        raise InputError(f"kept has shape {kept.shape}; it must be that of matrix, {matrix.shape}")
    found = cover(kept, width)
    columns = (found.columns[:, None] + np.arange(found.layout.width)).ravel()
    rows = np.repeat(found.rows, found.layout.width)
    mask = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=kept.shape)
    mask.data[:] = 1  # where the last two tiles of a row overlap, it was 2
    return given(matrix * mask)


def given(matrix: Any) -> scipy.sparse.csr_array:
    """A matrix as users hold it, sparse or dense, as a checked `csr_array`."""
    if scipy.sparse.issparse(matrix):
        checked = checks.csr("matrix", matrix)
        if np.all(checked.data):
            return checked
        checked = checked.copy()
        checked.eliminate_zeros()  # they would claim tiles
        return checked
    dense = checks.finite("matrix", checks.real("matrix", matrix))
    if dense.ndim != 2:
        raise InputError(f"matrix has shape {dense.shape}; it must be (M, N)")
    return checks.csr("matrix", scipy.sparse.csr_array(dense))


def _tiles(matrix: Any, found: Cover) -> np.ndarray:
    """The numbers of the tiles of a cover, (tiles, width) float64."""
    tiles = np.zeros((len(found.rows), found.layout.width))
    tiles[found.tile, matrix.indices - found.columns[found.tile]] = matrix.data
    return tiles


def _difference(matrix: Any, found: Cover, stored: Narrow) -> Difference:
    """Between a `csr_array` and its numbers as they are stored."""
    kept = stored.decoded()[found.tile, matrix.indices - found.columns[found.tile]]
    data = np.abs(matrix.data - kept)
    lost = scipy.sparse.csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)
    frobenius = float(np.linalg.norm(data))
    one, inf = (float(np.max(lost.sum(axis=axis), initial=0.0)) for axis in (0, 1))
    return Difference(frobenius, min(frobenius, (one * inf) ** 0.5))


def _packed(found: Cover, stored: Narrow, difference: Difference) -> Packed:
    layout, rows = found.layout, found.shape[0]
    places = -(-found.columns // layout.granule)
    page, places = (0, places) if layout.long else np.divmod(places, PLACES)
    counts = np.bincount(found.rows * layout.pages + page, minlength=rows * layout.pages)
    pointers = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Packed(found.shape, layout, pointers, places.astype(layout.place), stored, difference)


def _check(packed: Packed) -> None:
    """Refuse arrays that a kernel could read beyond, of other types than it reads, or not finite."""
    layout, (rows, columns), stored = packed.layout, packed.shape, packed.stored
    pointers, starts, codes, scales = packed.pointers, packed.starts, stored.codes, stored.scales
    tiles = len(starts)
    wanted = {
        "layout": layout.width in WIDTHS
        and layout.width <= max(columns, 1)
        and 1 <= layout.granule <= layout.width
        and layout.pages >= 1,
        "starts": starts.dtype == layout.place and starts.ndim == 1 and np.all(starts >= 0),
        "codes": codes.dtype == PRECISIONS[stored.precision].dtype and codes.shape == (tiles, layout.width),
        "scales": scales.dtype == np.uint8 and scales.shape == (tiles if stored.precision == "int8" else 0,),
        "pointers": pointers.dtype == np.int64
        and pointers.shape == (rows * layout.pages + 1,)
        and (pointers[0], pointers[-1]) == (0, tiles)
        and np.all(np.diff(pointers) >= 0),
        "unit, difference": np.all(np.isfinite([stored.unit, *packed.difference])),
    }
    bad = [name for name, fits in wanted.items() if not fits]
    if bad:
        raise InputError(f"{', '.join(bad)} of stored tiles do not fit; they must be what to_arrays gave")
    checks.finite("the numbers of stored tiles", stored.decoded())
    if np.max(packed.columns(), initial=0) > layout.last(columns):
        raise InputError("a stored tile reaches beyond the matrix; starts must be what to_arrays gave")
