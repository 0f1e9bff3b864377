# SPDX-License-Identifier: BSD-3-Clause
"""Bases: in which coefficients a picture is written. What they promise, and the orders of pixels.

An operator between two of them is R = W_out^T C W_in: W takes pictures to coefficients.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators.base import MOST, Operator, group_of, lanes_of
from ltcl.operators.orders import hilbert


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
        self, device: Device, grid: tuple[int, int], name: str, coefficients: int | None = None
    ) -> None:
        self.grid = checks.grid("grid", grid)
        pixels = self.grid[0] * self.grid[1]
        super().__init__(device, (pixels if coefficients is None else coefficients, pixels))
        self.name = name

    def diagonal(self) -> np.ndarray:
        """Refused where nobody has a use for it."""
        raise InputError(f"the basis {self.name} does not tell its diagonal")

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What `ltcl.operators.basis_of` makes it of again, as arrays that a file can hold."""
        return {"name": np.array(self.name), "grid": np.array(self.grid)}


class Ordered(Basis):
    """A permutation of pixels: coefficient i is pixel ``order[i]``.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    order : (N,) of int, or "hilbert"
        The pixel at each place, every one once; or a curve through all pixels that keeps neighbours together.
    name : str, optional
        What it is called: "hilbert", or "ordered" when not given.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Ordered
    >>> W = Ordered(ltcl.open_device(), (1, 3), order=[2, 0, 1])
    >>> (W @ numpy.array([10.0, 20.0, 30.0])).tolist()
    [30.0, 10.0, 20.0]
    """

    def __init__(
        self, device: Device, grid: tuple[int, int], order: Any = "hilbert", name: str | None = None
    ) -> None:
        named = isinstance(order, str)
        super().__init__(device, grid, name or (order if named else "ordered"))
        if named:
            checks.one_of("order", order, ["hilbert"])
            order = hilbert(self.grid)
        self.order = _permutation(order, self.shape[1])
        self._orders = [device.upload(o, np.int32) for o in (self.order, np.argsort(self.order))]

    @property
    def nbytes(self) -> int:
        """Bytes of the order and of its inverse."""
        return sum(order.nbytes for order in self._orders)

    def diagonal(self) -> np.ndarray:
        """1 where a pixel keeps its place, (N,) float64."""
        return (self.order == np.arange(len(self.order))).astype(np.float64)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and order."""
        return {**super().to_arrays(), "order": self.order}

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        move("ordered_gather", self._orders[transpose], x, out, scale, add)


class Chained(Basis):
    """One basis after another: ``outer @ inner``, such as wavelets and an order of their coefficients.

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
        super().__init__(inner.device, inner.grid, f"{inner.name}, {outer.name}", outer.shape[0])
        self.outer, self.inner = outer, inner
        self.orthonormal = outer.orthonormal and inner.orthonormal
        self.isometric = outer.isometric and inner.isometric

    @property
    def nbytes(self) -> int:
        """Bytes of both."""
        return self.outer.nbytes + self.inner.nbytes

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Those of both, named ``outer.`` and ``inner.``."""
        parts = {"outer": self.outer, "inner": self.inner}
        return {f"{part}.{key}": value for part in parts for key, value in parts[part].to_arrays().items()}

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        first, second = (self.outer, self.inner) if transpose else (self.inner, self.outer)
        between = self.device.empty((self.inner.shape[0], *x.shape[1:]))
        first._product(x, between, 1.0, None, transpose)
        second._product(between, out, scale, add, transpose)


def move(name: str, order: Array, x: Array, out: Array, scale: float, add: Array | None) -> None:
    """out = scale * x[order] + add of "ordered_gather", out[order] = scale * x + add[order] of "_scatter"."""
    rows, k = order.shape[0], x.columns
    if k == 0:
        return
    device, lanes = out.device, lanes_of(k)
    kernel = device.kernel("ordered", name, K=lanes)
    pieces = -(-k // lanes)
    across, group = (1, (1, 64)) if device.is_cpu else (pieces, group_of(pieces))
    adds, added = (0, out) if add is None else (1, add)
    kernel((across, min(rows, MOST)), group, rows, k, scale, adds, order, x, added, out)


def _permutation(order: Any, pixels: int) -> np.ndarray:
    order = checks.shape("order", checks.real("order", order), (pixels,))
    if order.dtype.kind not in "iu":
        raise InputError(f"order holds {order.dtype}; it must hold whole numbers")
    missing = np.setdiff1d(np.arange(pixels), order)
    if len(missing):
        raise InputError(f"order leaves out pixel {missing[0]}; it must name each of {pixels} once")
    return order.astype(np.int64)
