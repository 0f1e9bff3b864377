# SPDX-License-Identifier: BSD-3-Clause
"""xarray's arrays: values with names of axes and coordinates, which the result keeps.

The axes of a picture keep their names in their order. Coordinates stay on axes whose length stays.
An axis of colours behind them is called "colour", one before them "bounce".
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray

from ltcl.interop.arrays import Kind, kind_of, read

COLOUR = "colour"
BOUNCE = "bounce"


class LabelledKind(Kind):
    """`xarray.DataArray`."""

    def read(self, value: Any) -> np.ndarray:
        """The values, of whatever kind they are."""
        return read(value.data)

    def give(self, array: np.ndarray, like: Any) -> Any:
        """The values with the names and coordinates of `like`."""
        names = _names(array, like)
        coordinates = {}
        for name, coordinate in like.coords.items():
            lengths = dict(zip(coordinate.dims, coordinate.shape, strict=True))
            if all(_length(array, names, axis) == lengths[axis] for axis in coordinate.dims):
                coordinates[name] = coordinate
        inner = kind_of(type(like.data))
        values: Any = array
        if inner is not None:
            values = inner.give(array, like.data)
        else:
            values = self.in_type_of(array, like)
        return xarray.DataArray(values, dims=names, coords=coordinates)


def _names(array: np.ndarray, like: Any) -> tuple[Any, ...]:
    """The name of each axis of the result: of up to two that `like` lacks, bounces and colours."""
    added = array.ndim - like.ndim
    is_stack = array.shape[1:] == like.shape and array.shape[:-1] != like.shape
    names = like.dims
    if added == 2 or (added == 1 and not is_stack):
        names = (*names, COLOUR)
    if added == 2 or (added == 1 and is_stack):
        names = (BOUNCE, *names)
    return names


def _length(array: np.ndarray, names: tuple[Any, ...], axis: Any) -> int | None:
    """The length of the axis of that name, if there is one."""
    if axis not in names:
        return None
    return array.shape[names.index(axis)]


def is_array(cls: type) -> bool:
    """True for `DataArray` and what derives from it; a Dataset is no array."""
    return issubclass(cls, xarray.DataArray)


KIND = LabelledKind()
