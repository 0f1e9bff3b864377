# SPDX-License-Identifier: BSD-3-Clause
"""How R is written, by name: pixels, their order, wavelets for rows or both sides, wavelets and pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Basis, Chained, Ordered, Wavelet, basis, chosen, relatives
from ltcl.operators.wavelets import filters

PIXELS, HILBERT, ROWS, SUM = "pixels", "hilbert", " rows", " + pixels"
# In the order they are tried.
KINDS = ("db2", "haar", "db4", "db2 rows", "haar rows", PIXELS, HILBERT, f"db2{SUM}")


@dataclass(frozen=True)
class Kind:
    """R = out^T C into; None is pixels. Of a `sum`, R = P + out^T C into, P sparse."""

    name: str
    out: Basis | None
    into: Basis | None
    sum: bool = False

    @property
    def transforms(self) -> tuple[Callable | None, Callable | None]:
        """Both as functions of (N, k) arrays on the host."""
        return _function(self.out), _function(self.into)

    def only(self, places: np.ndarray | None) -> Kind:
        """The same with these coefficients of the basis of both sides alone; None are all."""
        if places is None or self.into is None or self.out is not self.into:
            return self
        V = chosen(self.into, places)
        return Kind(self.name, V, V)


def check(name: str) -> str:
    """Return `name` if it is that of a kind; refuse others."""
    if not isinstance(name, str):
        raise InputTypeError(f"basis is {name!r}; it must be a name, such as {', '.join(KINDS)}")
    if name not in (PIXELS, HILBERT):
        try:
            filters(_wavelet(name))
        except InputError as error:
            raise InputError(
                f"basis is {name!r}; it must be pixels, hilbert, or an orthonormal wavelet such as haar, db2 "
                "or db4, with ' rows' behind it for rows alone, or ' + pixels' for a sum of both"
            ) from error
    return name


def names(basis: Any) -> list[str]:
    """Those of one kind or of several, checked."""
    try:
        found = [basis] if isinstance(basis, str) else list(basis)
    except TypeError as error:
        raise InputTypeError(
            f"basis is {basis!r}; it must be a name, such as {', '.join(KINDS)}, or a list of names"
        ) from error
    if not found:
        raise InputError("basis is empty; it must name at least one")
    return [check(name) for name in found]


def kind(device: Device, grid: tuple[int, int], name: str) -> Kind:
    """The bases of a kind on a grid.

    >>> import ltcl
    >>> kind(ltcl.open_device(), (4, 6), "db2 rows").into.shape
    (24, 24)
    """
    W = basis(device, grid, _wavelet(check(name)))
    if isinstance(W, Wavelet):  # large coefficients then lie side by side, in fewer tiles
        W = Chained(Ordered(device, grid, relatives(grid, W.levels), "relatives"), W)
    return Kind(name, None if name.endswith(ROWS) else W, W, name.endswith(SUM))


def _wavelet(name: str) -> str:
    return name.removesuffix(ROWS) if name.endswith(ROWS) else name.removesuffix(SUM)


def _function(W: Basis | None) -> Callable[[np.ndarray], np.ndarray] | None:
    return None if W is None else lambda x: W.apply(W.device.upload(x)).get()
