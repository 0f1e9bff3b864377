# SPDX-License-Identifier: BSD-3-Clause
"""Bases: in which coefficients a picture is written. What they promise, and those made of others.

An operator between two of them is R = W_out^T C W_in: W takes pictures (N,) to coefficients (M,). Smooth
light transport in wavelets leaves most rows and columns of C empty: the others are its support, and with P,
(M, N), that picks them, C = P^T (P C P^T) P, so that vectors of M numbers will do where there were N.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.device.kernels import Kernel
from ltcl.errors import InputError
from ltcl.operators.base import PLAIN, WIDTHS, Epilogue, Operator

_GROUP = 64  # work-items side by side
_GROUPS = 1 << 14  # items along the second and third dimension, where kernels stride: GPUs take 65535 groups
_MOST = 0.5  # of the coefficients: where more are in the support, restricting to them gains little


class Basis(Operator):
    """W, (M, N): `apply` is analysis, from N pixels to M coefficients, `apply_transpose` synthesis.

    Attributes
    ----------
    grid : (h, w)
        Of the pictures; N = h * w pixels, row-major.
    name : str
        As `ltcl.operators.basis` takes it, where it can.
    orthonormal : bool
        Whether W W^T = W^T W = I, so that synthesis undoes analysis and keeps norms.
    isometric : bool
        Whether W W^T = I at least, so that synthesis keeps norms: some coefficients of an orthonormal basis.
    """

    orthonormal = True
    isometric = True

    def __init__(
        self,
        device: Device,
        grid: tuple[int, int],
        name: str,
        coefficients: int | None = None,
        *parts: Operator | Array,
    ) -> None:
        self.grid, self.name = checks.grid("grid", grid), name
        pixels = self.grid[0] * self.grid[1]
        super().__init__(device, (pixels if coefficients is None else coefficients, pixels), *parts)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What `ltcl.operators.basis_of` makes it of again, as arrays that a file can hold."""
        return {"name": np.array(self.name), "grid": np.array(self.grid)}

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue.without_shift(x)
        if out.size:
            self._transform(x, out, a, b, x if y is None else y, transpose)
        if c:
            vectors.axpy(c, x, out)

    def _transform(self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool) -> None:
        """Queue ``out = a (W x) + b y``, or with W^T; y is an array in any case, not read where b is 0."""
        raise TypeError(f"{type(self).__name__} does not implement _transform")

    def _kernel(self, file: str, name: str, k: int, **defines: Any) -> tuple[Kernel, int]:
        """A kernel for k right-hand sides, and in how many pieces it takes them."""
        lanes = next(width for width in WIDTHS if width <= k)
        return self.device.kernel(file, f"{file}_{name}", K=lanes, **defines), -(-k // lanes)


def launch_grid(kernel: Kernel, pieces: int, rows: int, columns: int, *arguments: Any) -> None:
    """Queue a kernel that strides through rows and columns: an item a row on CPUs, one a place on GPUs."""
    rows, columns = min(rows, _GROUPS), min(columns, _GROUPS)
    if kernel.device.is_cpu:
        kernel((pieces, 1, rows), (1, 1, 1), *arguments)
    else:
        kernel((pieces, columns, rows), (1, _GROUP, 1), *arguments)


def launch_group(kernel: Kernel, pieces: int, *arguments: Any) -> None:
    """Queue a kernel of which one group does all: an item on CPUs, up to 16 x 16 of them on GPUs."""
    group = (1, 1, 1) if kernel.device.is_cpu else kernel.group((1, 16, 16))
    kernel((pieces, *group[1:]), group, *arguments)


class SubsetBasis(Basis):
    """P, (M, N): coefficient i is pixel ``places[i]``; those left out are 0 in P^T. Of all: a permutation.

    Isometric, P P^T = I; orthonormal only where it names all pixels. After a basis,
    ``Chained(SubsetBasis(...), W)``, it picks from the coefficients of W.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    places : (M,) of int
        Pixels, row-major; none twice.
    name : str, optional

    Raises
    ------
    InputError
        No places, places outside the grid or named twice.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import SubsetBasis
    >>> P = SubsetBasis(ltcl.open_device(), (1, 4), [3, 1])
    >>> (P @ numpy.array([1.0, 2.0, 3.0, 4.0])).tolist(), (P.T @ numpy.array([4.0, 2.0])).tolist()
    ([4.0, 2.0], [0.0, 2.0, 0.0, 4.0])
    """

    def __init__(self, device: Device, grid: tuple[int, int], places: Any, name: str = "subset") -> None:
        h, w = checks.grid("grid", grid)
        self.places = _places(places, h * w)
        inverse = np.full(h * w, -1)
        inverse[self.places] = np.arange(len(self.places))
        self._orders = [device.upload(order, np.int32) for order in (self.places, inverse)]
        super().__init__(device, (h, w), name, len(self.places), *self._orders)
        self.orthonormal = self.shape[0] == self.shape[1]

    def diagonal(self) -> np.ndarray:
        """1 where a pixel keeps its place, (M,) float64."""
        return (self.places == np.arange(len(self.places))).astype(np.float64)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and places."""
        return {**super().to_arrays(), "places": self.places}

    def _transform(self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool) -> None:
        order, k = self._orders[transpose], x.columns
        kernel, pieces = self._kernel("ordered", "gather", k)
        items = pieces, min(order.size, _GROUPS)
        kernel(items, (1, _GROUP), order.size, k, a, b, order, x, y, out)


class Chained(Basis):
    """One basis after another: ``outer @ inner``, such as wavelets and some of their coefficients.

    Parameters
    ----------
    outer : Basis, (L, M)
        Takes the coefficients of `inner` for its pixels.
    inner : Basis, (M, N)
    """

    def __init__(self, outer: Basis, inner: Basis) -> None:
        if outer.shape[1] != inner.shape[0]:
            raise InputError(
                f"outer is for {outer.shape[1]} values; it must be for the {inner.shape[0]} of inner"
            )
        if outer.device is not inner.device:
            raise InputError(f"outer is on {outer.device}; it must be on {inner.device}, as inner is")
        name = f"{inner.name}, {outer.name}"
        super().__init__(inner.device, inner.grid, name, outer.shape[0], outer, inner)
        self.outer, self.inner = outer, inner
        self.orthonormal = outer.orthonormal and inner.orthonormal
        self.isometric = outer.isometric and inner.isometric

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Those of both, named ``outer.`` and ``inner.``."""
        parts = {"outer": self.outer, "inner": self.inner}
        return {f"{part}.{key}": value for part in parts for key, value in parts[part].to_arrays().items()}

    def _transform(self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool) -> None:
        first, second = (self.outer, self.inner) if transpose else (self.inner, self.outer)
        between = self.device.empty((self.inner.shape[0], *x.shape[1:]))
        first._product(x, between, PLAIN, transpose)
        second._product(between, out, Epilogue(a, b, y), transpose)


def support(core: Any) -> np.ndarray | None:
    """The coefficients whose row or column of a square sparse `core` is not empty, where they are few.

    None where they are more than half. There is always one at least.

    >>> support(scipy.sparse.csr_array(([0.5], ([1], [3])), shape=(5, 5))).tolist()
    [1, 3]
    """
    core = scipy.sparse.csr_array(core)
    used = np.diff(core.indptr) > 0
    used[core.indices] = True
    places = np.flatnonzero(used) if used.any() else np.arange(min(1, len(used)))
    return places if len(places) <= _MOST * len(used) else None


def restrict(W: Basis, places: np.ndarray) -> Basis:
    """The coefficients `places` of W as a basis; a choice among coefficients becomes part of the new one."""
    if isinstance(W, SubsetBasis):
        return SubsetBasis(W.device, W.grid, W.places[places])
    if isinstance(W, Chained) and isinstance(W.outer, SubsetBasis):
        return restrict(W.inner, W.outer.places[places])
    return Chained(SubsetBasis(W.device, (1, W.shape[0]), places), W)


def restrict_to_support(core: Any, W: Basis) -> tuple[scipy.sparse.csr_array, Basis]:
    """C and W with W^T C W as before, but on the support of C alone where that is small."""
    core, places = scipy.sparse.csr_array(core), support(core)
    if places is None:
        return core, W
    return scipy.sparse.csr_array(core[places][:, places]), restrict(W, places)


def multiresolution_order(grid: Any, levels: int) -> np.ndarray:
    """An order of 2-D wavelet coefficients in which those of one place and size stand together, (N,) int64.

    From coarse to fine; in each level along a Hilbert curve, the details of a place side by side. Rows of
    W R W^T then have their large entries in runs, which `Tiles` hold under one column index each: with 30
    numbers a row kept (diffuse dihedral, N = 4608, db2), 7.7 tiles of 8 instead of 9.7.

    Parameters
    ----------
    grid : (h, w)
        Coefficients in the layout of `Wavelet`; of a length n the approximation has ceil(n / 2).
    levels : int
        Of the transform, 0 or more.

    Examples
    --------
    >>> multiresolution_order((2, 4), 1).tolist()
    [0, 1, 2, 4, 6, 3, 5, 7]
    """
    h, w = checks.grid("grid", grid)
    checks.count("levels", levels, least=0)
    y, x = np.divmod(np.arange(h * w), w)
    level, band = np.zeros((2, h * w), int)
    for split in range(min(levels, (max(h, w) - 1).bit_length())):
        rows, columns = -(-h >> 1), -(-w >> 1)
        down, right = (y >= rows) & (level == 0), (x >= columns) & (level == 0)
        y, x = y - rows * down, x - columns * right
        band += 2 * down + right
        level[down | right] = levels - split
        h, w = rows, columns
    return np.lexsort((band, _hilbert(y, x), level))


def _hilbert(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """How far along Hilbert's curve through the least square that holds them the places (y, x) stand."""
    half = 1 << (int(max(y.max(), x.max())).bit_length())
    distance = np.zeros_like(y)
    while half := half >> 1:
        below, right = (y & half) > 0, (x & half) > 0
        distance += half * half * ((3 * right) ^ below)
        y, x = y & (half - 1), x & (half - 1)
        turned = right & ~below
        y, x = np.where(turned, half - 1 - y, y), np.where(turned, half - 1 - x, x)
        y, x = np.where(below, y, x), np.where(below, x, y)
    return distance


def _places(places: Any, pixels: int) -> np.ndarray:
    places = checks.real("places", places)
    if places.ndim != 1 or not len(places) or places.dtype.kind not in "iu":
        raise InputError(f"places has shape {places.shape} of {places.dtype}; it must be (M,) whole numbers")
    if places.min() < 0 or places.max() >= pixels:
        raise InputError(f"places reach from {places.min()} to {places.max()}; they must be among {pixels}")
    if len(np.unique(places)) < len(places):
        raise InputError(f"places name some of {pixels} pixels twice; they must be different")
    return places.astype(np.int64)
