# SPDX-License-Identifier: BSD-3-Clause
"""Bases: the coefficients in which a picture is written, and subsets of them as bases of their own.

An operator between two bases is R = W_out^T C W_in. Smooth light transport in wavelets leaves most
rows and columns of C empty; with P, (M, N), that picks the others, its support,
C = P^T (P C P^T) P.
"""

from __future__ import annotations

import abc
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.device.kernels import Kernel, Launch, Queued, in_order
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import PLAIN, Epilogue, widest_launch

# The name of no basis.
PIXELS = "pixels"
# Work-items side by side on a GPU.
GROUP_ITEMS = 64
# Items of a CPU along a dimension in which kernels stride.
MAX_STRIDING_ITEMS = 1 << 14
# Groups of a GPU along its second and third dimension, in which kernels stride.
MAX_GROUPS = 65535
# Sides of the group of a GPU that does several levels of a picture alone.
LEVELS_GROUP = (32, 32)
# Pixels of a level up to which one launch does all the levels from it on: on a CPU, and for each
# item of the largest group on a GPU, where a launch takes longer than a few turns of a group.
SMALL_LEVEL_PIXELS = 4096
SMALL_LEVEL_ITEM_PIXELS = 8
# Share of the coefficients in the support beyond which restricting to it gains little.
MAX_SUPPORT_SHARE = 0.5


class Basis(Operator):
    """W, (M, N): `apply` is analysis, from N pixels to M coefficients, `apply_transpose` synthesis.

    Subclasses write `_bind_transform`.

    Attributes
    ----------
    grid : (h, w)
        Size of the pictures; N = h * w pixels, row-major.
    name : str
        As `ltcl.operators.basis` takes it.
    orthonormal, isometric : bool
        Whether synthesis undoes analysis, W W^T = W^T W = I; whether it keeps norms, W W^T = I.
    """

    orthonormal = True
    isometric = True

    def __init__(
        self,
        device: Device,
        grid: Any,
        name: str,
        coefficients: int,
        *parts: Operator | Array | None,
    ) -> None:
        h, w = checks.grid("grid", grid)
        self.grid = (h, w)
        self.name = name
        super().__init__(device, (coefficients, h * w), *parts)

    @abc.abstractmethod
    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        """The launches of out = a (W x) + b y, or with W^T; c of the epilogue is 0."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Arrays that a file can hold, from which `ltcl.operators.stored` makes the basis again."""
        return {"name": np.array(self.name), "grid": np.array(self.grid)}

    def columns_of(self, pixels: np.ndarray) -> scipy.sparse.csr_array | None:
        """The columns of W that belong to some pixels, (M, n); None if the host has no W."""
        return None

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        epilogue = epilogue.without_shift(x)
        launches: list[Queued] = []
        if out.size:
            unshifted = Epilogue(a=epilogue.a, b=epilogue.b, y=epilogue.y)
            launches.append(self._bind_transform(x, out, unshifted, transpose))
        if epilogue.c:
            launches.append(vectors.bind_axpby(epilogue.c, x, 1.0, out, out))
        return in_order(launches)

    def _kernel(self, file: str, name: str, k: int, **defines: Any) -> tuple[Kernel, int]:
        """A kernel for k right-hand sides, and the number of pieces in which it takes them.

        An item of a GPU takes one, beside items that take the others: few registers, many items.
        """
        lanes = widest_launch(k) if self.device.is_cpu else 1
        kernel = self.device.kernel(file, f"{file}_{name}", K=lanes, **defines)
        return kernel, -(-k // lanes)

    def bind_ordered(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool, order: Array
    ) -> Queued | None:
        """The launches of out = a (P W x) + b y, or with its transpose, without a gather.

        P puts coefficient i into row ``order[i]``, or nowhere if that is negative. None if the
        basis has no such launches.
        """
        return None


def small_level_pixels(device: Device) -> int:
    """Pixels of a level up to which one launch does all the levels from it on."""
    if device.is_cpu:
        return SMALL_LEVEL_PIXELS
    return SMALL_LEVEL_ITEM_PIXELS * device.max_group


def bind_grid(
    kernel: Kernel, pieces: int, grid: tuple[int, int], pictures: int = 1, **arguments: Any
) -> Launch:
    """The launch of a kernel that strides through rows and columns.

    A CPU has an item for each row of `grid`, a GPU one for each place.
    """
    rows, columns = grid
    if kernel.device.is_cpu:
        items = (pieces * pictures, 1, min(rows, MAX_STRIDING_ITEMS))
        return kernel.bind(items, (1, 1, 1), **arguments)
    group = (*_group_of_places(kernel, pieces), 1)
    across = min(columns, MAX_GROUPS * group[1])
    items = (pieces * pictures, across, min(rows, MAX_GROUPS))
    return kernel.bind(items, group, **arguments)


def bind_line(kernel: Kernel, pieces: int, count: int, **arguments: Any) -> Launch:
    """The launch of a kernel that strides through `count` places in a line."""
    if kernel.device.is_cpu:
        group = (1, GROUP_ITEMS)
        most = MAX_STRIDING_ITEMS
    else:
        group = _group_of_places(kernel, pieces)
        most = MAX_GROUPS * group[1]
    return kernel.bind((pieces, min(count, most)), group, **arguments)


def bind_group(kernel: Kernel, pieces: int, **arguments: Any) -> Launch:
    """The launch of a kernel of which one group does all of a piece.

    The group is one item on a CPU, and as large as it may be on a GPU.
    """
    if kernel.device.is_cpu:
        group = (1, 1, 1)
    else:
        group = kernel.group((1, *LEVELS_GROUP))
    return kernel.bind((pieces, *group[1:]), group, **arguments)


def _group_of_places(kernel: Kernel, pieces: int) -> tuple[int, int]:
    """A group of a GPU: all pieces of some places, whose numbers lie side by side, if they fit."""
    group = kernel.group((pieces, max(1, GROUP_ITEMS // pieces)))
    if pieces % group[0]:
        return kernel.group((1, GROUP_ITEMS))
    return group


class SubsetBasis(Basis):
    """P, (M, N): coefficient i is pixel ``places[i]``; pixels left out are 0 in P^T.

    With `of` it is P W: some coefficients of W instead of pixels. All places make a permutation.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    places : (M,) of int
        Pixels, row-major, or coefficients of W; InputError if there are none, or one twice.
    of : Basis, optional
        W, of the same device and grid. For a subset the places are among its coefficients.

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
        self.places = _check_places(places, _count_coefficients((h, w), of))
        if isinstance(of, SubsetBasis):
            self.places = of.places[self.places]
            of = of.of
        self.of = of
        count = _count_coefficients((h, w), of)
        inverse = np.full(count, -1)
        inverse[self.places] = np.arange(len(self.places))
        self._order = device.upload(self.places, np.int32)
        self._inverse_order = device.upload(inverse, np.int32)
        size = len(self.places)
        super().__init__(device, (h, w), PIXELS, size, self._order, self._inverse_order, of)
        if of is not None:
            self.name = of.name
            self.orthonormal = of.orthonormal
            self.isometric = of.isometric
        # Synthesis can not bring back what a true subset leaves out.
        if size < count:
            self.orthonormal = False

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of W, or name and grid, and the places."""
        if self.of is not None:
            return {**self.of.to_arrays(), "places": self.places}
        return {**super().to_arrays(), "places": self.places}

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        if self.of is None:
            return self._bind_gather(x, out, epilogue, transpose)
        ordered = self.of.bind_ordered(x, out, epilogue, transpose, self._inverse_order)
        if ordered is not None:
            return ordered
        coefficients = self.device.empty((self.of.shape[0], *x.shape[1:]))
        if transpose:
            # The places of a subset never change: the others stay 0.
            vectors.fill(coefficients, 0.0)
            scatter = self._bind_scatter(x, coefficients)
            synthesis = self.of._bind_product(coefficients, out, epilogue, True)
            return in_order([scatter, synthesis])
        analysis = self.of._bind_product(x, coefficients, PLAIN, False)
        gather = self._bind_gather(coefficients, out, epilogue, transpose)
        return in_order([analysis, gather])

    def _bind_scatter(self, x: Array, out: Array) -> Launch:
        """The launch that writes x to its places in `out`, and nothing else."""
        kernel, pieces = self._kernel("ordered", "scatter", x.columns)
        count = self._order.size
        return bind_line(
            kernel, pieces, count, rows=count, k=x.columns, order=self._order, x=x, out=out
        )

    def _bind_gather(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Launch:
        """The launch of out = a (P x) + b y, or with P^T."""
        order = self._inverse_order if transpose else self._order
        kernel, pieces = self._kernel("ordered", "gather", x.columns)
        return bind_line(
            kernel,
            pieces,
            order.size,
            rows=order.size,
            k=x.columns,
            a=epilogue.a,
            b=epilogue.b,
            order=order,
            x=x,
            y=epilogue.operand(x),
            out=out,
        )


class ScaledBasis(Basis):
    """W diag(scale), (M, N): a basis W of pictures whose pixels are scaled.

    W^T x is then multiplied by the scale of each pixel, such as the albedo of a surface under
    light that is smooth.

    Parameters
    ----------
    of : Basis
        W.
    scale : (N,)

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Hats, ScaledBasis
    >>> W = ScaledBasis(Hats(ltcl.open_device(), (1, 2)), [2.0, 3.0])
    >>> (W.T @ numpy.ones(2)).tolist()
    [2.0, 3.0]
    """

    def __init__(self, of: Basis, scale: Any) -> None:
        factors = checks.shape("scale", checks.real("scale", scale), of.shape[1:])
        self.scale = checks.finite("scale", factors)
        self.of = of
        self._scale = of.device.upload(self.scale)
        super().__init__(of.device, of.grid, of.name, of.shape[0], of, self._scale)
        self.orthonormal = False
        self.isometric = False

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of W, and the scale."""
        return {**self.of.to_arrays(), "scale": self.scale}

    def columns_of(self, pixels: np.ndarray) -> scipy.sparse.csr_array | None:
        """Scaled columns of W."""
        columns = self.of.columns_of(pixels)
        if columns is None:
            return None
        return scipy.sparse.csr_array(columns * self.scale[pixels])

    def _bind_transform(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Queued:
        if transpose:
            product = self.device.empty(out.shape)
            synthesis = self.of._bind_product(x, product, PLAIN, True)
            scale = vectors.bind_scale_rows(self._scale, product, product)
            y = product
            if epilogue.b and epilogue.y is not None:
                y = epilogue.y
            add = vectors.bind_axpby(epilogue.a, product, epilogue.b, y, out)
            return in_order([synthesis, scale, add])
        scaled = x.like()
        scale = vectors.bind_scale_rows(self._scale, x, scaled)
        analysis = self.of._bind_product(scaled, out, epilogue, False)
        return in_order([scale, analysis])


def _count_coefficients(grid: tuple[int, int], of: Basis | None) -> int:
    """The pixels of a grid, or the coefficients of W."""
    if of is None:
        return grid[0] * grid[1]
    return of.shape[0]


def _check_places(places: Any, count: int) -> np.ndarray:
    """`places` as (M,) int64; refused if they are not different numbers below `count`."""
    places = checks.real("places", places)
    if places.ndim != 1 or not len(places) or places.dtype.kind not in "iu":
        kind = f"{places.shape} of {places.dtype}"
        raise InputError(f"places has shape {kind}; it must be (M,) whole numbers")
    lowest = places.min()
    highest = places.max()
    if lowest < 0 or highest >= count or len(np.unique(places)) < len(places):
        raise InputError(f"places are {lowest} to {highest}; they must be different, below {count}")
    return places.astype(np.int64)


def restrict_to_support(core: Any, W: Basis) -> tuple[scipy.sparse.csr_array, Basis]:
    """C and W on the support of the square sparse C, its rows or columns not empty.

    W^T C W is as before. If the support is more than half of all coefficients, both come back as
    they were.
    """
    core = scipy.sparse.csr_array(core)
    is_used = np.diff(core.indptr) > 0
    is_used[core.indices] = True
    places = np.flatnonzero(is_used)
    if not len(places):
        places = np.arange(min(1, len(is_used)))
    if len(places) > MAX_SUPPORT_SHARE * len(is_used):
        return core, W
    restricted = scipy.sparse.csr_array(core[places][:, places])
    return restricted, SubsetBasis(W.device, W.grid, places, W)


def multiresolution_order(grid: Any, levels: int) -> np.ndarray:
    """An order of 2-D wavelet coefficients with those of one place and size together, (N,) int64.

    From coarse to fine, in each level row by row, the details of a place side by side: rows of W R
    W^T then have their large entries in runs, which `Tiles` of 8 hold in a fifth fewer bytes.
    Coefficients are in the layout of a `Wavelet` of so many `levels`.

    >>> multiresolution_order((2, 4), 1).tolist()
    [0, 1, 2, 4, 6, 3, 5, 7]
    """
    h, w = checks.grid("grid", grid)
    checks.count("levels", levels, least=0)
    y, x = np.divmod(np.arange(h * w), w)
    level = np.zeros(h * w, int)
    band = np.zeros(h * w, int)
    splits = min(levels, (max(h, w) - 1).bit_length())
    for split in range(splits):
        rows = -(-h >> 1)
        columns = -(-w >> 1)
        # Details are below or right of the approximation.
        is_below = (y >= rows) & (level == 0)
        is_right = (x >= columns) & (level == 0)
        y = y - rows * is_below
        x = x - columns * is_right
        band += 2 * is_below + is_right
        level[is_below | is_right] = levels - split
        h = rows
        w = columns
    return np.lexsort((band, x, y, level))
