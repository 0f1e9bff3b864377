# SPDX-License-Identifier: BSD-3-Clause
"""Some of the coefficients of a basis: those that a core acts on.

Smooth light transport in wavelets leaves most rows and columns of C empty. With P, (M, N), that picks the
others, C = P^T (P C P^T) P, and vectors of M numbers will do where there were N.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError
from ltcl.operators.bases import Basis, Chained, Ordered, move

_MOST = 0.5  # of the coefficients: where more are active, selecting them gains little


class Selected(Basis):
    """P, (M, N): coefficient i is pixel ``places[i]``; the others are left out, and P^T gives 0 there.

    Isometric, P P^T = I, but not orthonormal: P^T P is not I. After a basis, ``Chained(Selected(...), W)``,
    it picks from the coefficients of W.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    places : (M,) of int
        Pixels, row-major; none twice.

    Raises
    ------
    InputError
        No places, places outside the grid or named twice.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Selected
    >>> P = Selected(ltcl.open_device(), (1, 4), [3, 1])
    >>> (P @ numpy.array([1.0, 2.0, 3.0, 4.0])).tolist(), (P.T @ numpy.array([4.0, 2.0])).tolist()
    ([4.0, 2.0], [0.0, 2.0, 0.0, 4.0])
    """

    def __init__(self, device: Device, grid: tuple[int, int], places: Any) -> None:
        h, w = checks.grid("grid", grid)
        self.places = _places(places, h * w)
        super().__init__(device, (h, w), "selected", len(self.places))
        self.orthonormal = self.shape[0] == self.shape[1]
        self._order = device.upload(self.places, np.int32)

    @property
    def nbytes(self) -> int:
        """Bytes of the places."""
        return self._order.nbytes

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Name, grid and places."""
        return {**super().to_arrays(), "places": self.places}

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if not transpose:
            move("ordered_gather", self._order, x, out, scale, add)
            return
        if add is None:
            vectors.fill(out, 0.0)
        elif add is not out:
            out.copy_from(add)
        move("ordered_scatter", self._order, x, out, scale, add)


def active(core: Any) -> np.ndarray | None:
    """The coefficients whose row or column of a square sparse `core` is not empty, where they are few.

    None where they are more than half. There is always one at least.

    >>> active(scipy.sparse.csr_array(([0.5], ([1], [3])), shape=(5, 5))).tolist()
    [1, 3]
    """
    core = scipy.sparse.csr_array(core)
    used = np.diff(core.indptr) > 0
    used[core.indices] = True
    found = np.flatnonzero(used) if used.any() else np.arange(min(1, len(used)))
    return found if len(found) <= _MOST * len(used) else None


def chosen(W: Basis, places: np.ndarray) -> Basis:
    """The coefficients `places` of W as a basis; an order of coefficients becomes part of the choice."""
    if isinstance(W, Ordered):
        return Selected(W.device, W.grid, W.order[places])
    if isinstance(W, Chained) and isinstance(W.outer, Ordered):
        return chosen(W.inner, W.outer.order[places])
    return Chained(Selected(W.device, (1, W.shape[0]), places), W)


def on_active(core: Any, W: Basis) -> tuple[scipy.sparse.csr_array, Basis]:
    """C and W with W^T C W as before, but of active coefficients alone where these are few."""
    core, places = scipy.sparse.csr_array(core), active(core)
    if places is None:
        return core, W
    return scipy.sparse.csr_array(core[places][:, places]), chosen(W, places)


def _places(places: Any, pixels: int) -> np.ndarray:
    found = checks.real("places", places)
    if found.ndim != 1 or not len(found) or found.dtype.kind not in "iu":
        raise InputError(f"places has shape {found.shape} of {found.dtype}; it must be (M,) whole numbers")
    if found.min() < 0 or found.max() >= pixels:
        raise InputError(f"places reach from {found.min()} to {found.max()}; they must be among {pixels}")
    found = found.astype(np.int64)
    if len(np.unique(found)) < len(found):
        raise InputError(f"places name some of {pixels} pixels twice; they must be different")
    return found
