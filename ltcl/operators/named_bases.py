# SPDX-License-Identifier: BSD-3-Clause
"""Bases by name, and those that a file holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators.bases import Basis, Chained, Ordered
from ltcl.operators.pyramid import Pyramid
from ltcl.operators.selected import Selected
from ltcl.operators.wavelets import Wavelet, families, is_known


def basis(device: Device, grid: tuple[int, int], name: str) -> Basis | None:
    """The basis called `name` of pictures of h x w pixels.

    Parameters
    ----------
    device : Device
    grid : (h, w)
    name : str
        "pixels" (None: no basis is needed), "hilbert" (pixels in the order of a space-filling curve),
        "pyramid", or an orthonormal wavelet of PyWavelets: "haar", "db2", "db4", ...

    Raises
    ------
    InputError
        Another name, or a wavelet that is not orthonormal.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.operators import basis
    >>> basis(ltcl.open_device(), (8, 8), "db2").orthonormal
    True
    """
    if name == "pixels":
        return None
    if name == "hilbert":
        return Ordered(device, grid, name)
    if name == "pyramid":
        return Pyramid(device, grid)
    if not is_known(name):
        wavelets = f"an orthonormal wavelet ({families()})"
        raise InputError(f"basis is {name!r}; it must be pixels, hilbert, pyramid or {wavelets}")
    return Wavelet(device, grid, name)


def basis_of(device: Device, arrays: Mapping[str, Any]) -> Basis:
    """The basis whose `to_arrays` gave `arrays`.

    Raises
    ------
    InputError
        Arrays that are missing or describe no basis.
    """
    parts = [_part(arrays, f"{part}.") for part in ("outer", "inner")]
    if any(parts):
        return Chained(*(basis_of(device, part) for part in parts))
    missing = sorted({"name", "grid"} - set(arrays))
    if missing:
        raise InputError(f"the arrays of a basis lack {' and '.join(missing)}")
    name, grid = str(arrays["name"]), tuple(np.ravel(arrays["grid"]).tolist())
    if "order" in arrays:
        return Ordered(device, grid, arrays["order"], name)
    if "places" in arrays:
        return Selected(device, grid, arrays["places"])
    if "levels" in arrays:
        return Wavelet(device, grid, name, np.asarray(arrays["levels"]).tolist())
    found = basis(device, grid, name)
    if found is None:
        raise InputError(f"the arrays describe {name}, which is no basis")
    return found


def _part(arrays: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}
