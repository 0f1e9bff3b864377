# SPDX-License-Identifier: BSD-3-Clause
"""Bases: in which coefficients a picture is written, and some of their coefficients as bases of their own.

An operator between two bases is R = W_out^T C W_in. Smooth light transport in wavelets leaves most
rows and columns of C empty; with P, (M, N), that picks the others, its support, C = P^T (P C P^T)
P.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.device.kernels import Kernel
from ltcl.errors import InputError
from ltcl.operators.base import PLAIN, WIDTHS, Epilogue, Operator

_GROUP = 64  # work-items side by side
_GROUPS = (
    1 << 14
)  # items along the second and third dimension, where kernels stride: GPUs take 65535 groups
_MOST = 0.5  # of the coefficients: where more are in the support, restricting to them gains little


class Basis(Operator):
    """W, (M, N): `apply` is analysis, from N pixels to M coefficients, `apply_transpose` synthesis.

    Attributes
    ----------
    grid : (h, w) of the pictures; N = h * w pixels, row-major
    name : str, as `ltcl.operators.basis` takes it
    orthonormal, isometric : bool
        Whether synthesis undoes analysis, W W^T = W^T W = I; whether it keeps norms, W W^T = I.
    """

    orthonormal = True
    isometric = True
    # (x, out, a, b, y, transpose): queues out = a (W x) + b y, or with W^T; y is not read where b
    # is 0.
    _transform: Callable[[Array, Array, float, float, Array, bool], None]

    def __init__(
        self,
        device: Device,
        grid: Any,
        name: str,
        coefficients: int,
        *parts: Operator | Array | None,
    ) -> None:
        self.grid, self.name = checks.grid("grid", grid), name
        super().__init__(device, (coefficients, self.grid[0] * self.grid[1]), *parts)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What `ltcl.operators.basis_of` makes it of again, as arrays that a file can hold."""
        return {"name": np.array(self.name), "grid": np.array(self.grid)}

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue.without_shift(x)
        if out.size:
            self._transform(x, out, a, b, x if y is None else y, transpose)
        if c:
            vectors.axpy(c, x, out)

    def _kernel(self, file: str, name: str, k: int, **defines: Any) -> tuple[Kernel, int]:
        """A kernel for k right-hand sides, and in how many pieces it takes them."""
        lanes = next(width for width in WIDTHS if width <= k)
        return self.device.kernel(file, f"{file}_{name}", K=lanes, **defines), -(-k // lanes)


def launch_grid(kernel: Kernel, pieces: int, rows: int, columns: int, *arguments: Any) -> None:
    """Queue a kernel that strides through rows and columns: an item a row on CPUs, one a place on GPUs."""
    across, group = (1, 1) if kernel.device.is_cpu else (min(columns, _GROUPS), _GROUP)
    kernel((pieces, across, min(rows, _GROUPS)), (1, group, 1), *arguments)


def launch_group(kernel: Kernel, pieces: int, *arguments: Any) -> None:
    """Queue a kernel of which one group does all: an item on CPUs, up to 16 x 16 of them on GPUs."""
    group = (1, 1, 1) if kernel.device.is_cpu else kernel.group((1, 16, 16))
    kernel((pieces, *group[1:]), group, *arguments)


class SubsetBasis(Basis):
    """P, (M, N): coefficient i is pixel ``places[i]``; those left out are 0 in P^T. Of all: a permutation.

    With `of` it is P W: some coefficients of W instead of pixels.

    Parameters
    ----------
    places : (M,) of int
        Pixels, row-major, or coefficients of W; InputError where there are none, or one twice.
    of : Basis, optional
        W, of the same device and grid. Of a subset: places among its coefficients.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import SubsetBasis
    >>> P = SubsetBasis(ltcl.open_device(), (1, 4), [3, 1])
    >>> (P @ numpy.array([1.0, 2.0, 3.0, 4.0])).tolist(), (P.T @ numpy.array([4.0, 2.0])).tolist()
    ([4.0, 2.0], [0.0, 2.0, 0.0, 4.0])
    """

    def __init__(self, device: Device, grid: Any, places: Any, of: Basis | None = None) -> None:
        h, w = checks.grid("grid", grid)
        if of is not None and (of.device is not device or of.grid != (h, w)):
            raise InputError(
                f"of is for {of.grid} on {of.device}; it must be for {(h, w)} on {device}"
            )
        count, places = h * w if of is None else of.shape[0], checks.real("places", places)
        if places.ndim != 1 or not len(places) or places.dtype.kind not in "iu":
            kind = f"{places.shape} of {places.dtype}"
            raise InputError(f"places has shape {kind}; it must be (M,) whole numbers")
        least, most = places.min(), places.max()
        if least < 0 or most >= count or len(np.unique(places)) < len(places):
            raise InputError(f"places are {least} to {most}; they must be different, below {count}")
        self.places = places.astype(np.int64)
        if isinstance(of, SubsetBasis):
            self.places, of = of.places[self.places], of.of
        self.of, count = of, h * w if of is None else of.shape[0]
        inverse = np.full(count, -1)
        inverse[self.places] = np.arange(len(self.places))
        self._orders = [device.upload(order, np.int32) for order in (self.places, inverse)]
        name = "pixels" if of is None else of.name
        super().__init__(device, (h, w), name, len(self.places), *self._orders, of)
        self.orthonormal = len(self.places) == count and (of is None or of.orthonormal)
        self.isometric = of is None or of.isometric

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Those of W, or name and grid, and the places."""
        own = super().to_arrays() if self.of is None else self.of.to_arrays()
        return {**own, "places": self.places}

    def _transform(
        self, x: Array, out: Array, a: float, b: float, y: Array, transpose: bool
    ) -> None:
        order, k = self._orders[transpose], x.columns
        kernel, pieces = self._kernel("ordered", "gather", k)
        items, group = (pieces, min(order.size, _GROUPS)), (1, _GROUP)
        if self.of is None:
            kernel(items, group, order.size, k, a, b, order, x, y, out)
            return
        coefficients = self.device.empty((self.of.shape[0], *x.shape[1:]))
        if transpose:
            kernel(items, group, order.size, k, 1.0, 0.0, order, x, x, coefficients)
            self.of._product(coefficients, out, Epilogue(a, b, y), True)
        else:
            self.of._product(x, coefficients, PLAIN, False)
            kernel(items, group, order.size, k, a, b, order, coefficients, y, out)


def restrict_to_support(core: Any, W: Basis) -> tuple[scipy.sparse.csr_array, Basis]:
    """C and W with W^T C W as before, on the support of the square sparse C alone: rows or columns not empty.

    Where that is more than half of all coefficients, both come back as they were.
    """
    core = scipy.sparse.csr_array(core)
    used = np.diff(core.indptr) > 0
    used[core.indices] = True
    places = np.flatnonzero(used) if used.any() else np.arange(min(1, len(used)))
    if len(places) > _MOST * len(used):
        return core, W
    return scipy.sparse.csr_array(core[places][:, places]), SubsetBasis(W.device, W.grid, places, W)


def multiresolution_order(grid: Any, levels: int) -> np.ndarray:
    """An order of 2-D wavelet coefficients in which those of one place and size stand together, (N,) int64.

    From coarse to fine, in each level row by row, the details of a place side by side: rows of W R
    W^T then have their large entries in runs, which `Tiles` of 8 hold in a fifth fewer bytes.
    Coefficients are in the layout of a `Wavelet` of so many `levels`.

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
    return np.lexsort((band, x, y, level))
