# SPDX-License-Identifier: BSD-3-Clause
"""Response curves as tables: linear light at equally spaced codes, one table for each channel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError

# A function of one plane of an image, and of the table of its channel.
PlaneFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, repr=False, eq=False)
class Response:
    """Response of a camera or projector, from codes to linear values.

    A table never falls; it is linear between and beyond its codes. Tables of `calibrate` are 0
    without light, so that their first values are negative.

    Parameters
    ----------
    values : (1, n) or (3, n) array_like
        Linear values at n equally spaced codes from 0 to 1; kept as float64.

    Raises
    ------
    InputError
        The shape is another, values has NaN, or a table falls or never rises.

    Examples
    --------
    >>> gamma = Response(np.linspace(0, 1, 257) ** 2.0)
    >>> gamma.linear(np.array([[0.0, 0.5, 1.0]]))
    array([[0.  , 0.25, 1.  ]], dtype=float32)
    """

    values: np.ndarray

    def __post_init__(self) -> None:
        table = checks.real("values", self.values).astype(np.float64)
        values = np.atleast_2d(table)
        shape = values.shape
        if len(shape) != 2 or shape[0] not in (1, 3) or shape[1] < 2:
            raise InputError(f"values has shape {shape}; it must be (1, n) or (3, n), n at least 2")
        checks.finite("values", values)
        is_constant = values[:, -1] <= values[:, 0]
        if np.diff(values).min() < 0 or np.any(is_constant):
            raise InputError("values falls, or stays the same throughout; a response must rise")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    def __repr__(self) -> str:
        channels, n = self.values.shape
        return f"{type(self).__name__}(channels={channels}, n={n})"

    @classmethod
    def identity(cls) -> Response:
        """Response of codes that are linear already."""
        return cls(np.array([[0.0, 1.0]]))

    @property
    def channels(self) -> int:
        """Number of tables, 1 or 3."""
        return self.values.shape[0]

    def linear(self, image: Any) -> np.ndarray:
        """Linear values of codes (..., [3]) in [0, 1]; float32, same shape."""
        return self._map_channels(interpolate, image)

    def derivative(self, image: Any) -> np.ndarray:
        """Linear value per code, at codes (..., [3]) in [0, 1]; float32, same shape."""
        return self._map_channels(_slope, image)

    def codes(self, linear: Any) -> np.ndarray:
        """Codes (..., [3]) that have these linear values, within [0, 1]; float32, same shape."""
        return self._map_channels(_invert, linear)

    def _map_channels(self, function: PlaneFunction, image: Any) -> np.ndarray:
        """Apply a function of a plane and its table to each channel, float32.

        A response of one table takes the whole image as one plane.
        """
        array = checks.real("image", image)
        if array.dtype.kind != "f":
            raise InputError(f"image holds {array.dtype}; codes must be floats, 1 for the largest")
        if self.channels == 1:
            return np.asarray(function(array, self.values[0]), np.float32)
        if array.shape[-1:] != (3,):
            raise InputError(f"image has shape {array.shape}; this response needs (..., 3)")
        planes = []
        for c, table in enumerate(self.values):
            planes.append(function(array[..., c], table))
        return np.stack(planes, axis=-1).astype(np.float32)


def interpolate(codes: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Values at codes, which may lie beyond the ends of the table."""
    place, interval = _intervals(codes, table)
    step = np.diff(table)[interval]
    return table[interval] + (place - interval) * step


def _slope(codes: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Slope of the table at codes, which may lie beyond its ends."""
    _, interval = _intervals(codes, table)
    return (len(table) - 1) * np.diff(table)[interval]


def _invert(light: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Codes at which the table has these values."""
    return np.interp(light, table, np.linspace(0, 1, len(table)))


def _intervals(codes: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of codes among the values of the table, and the interval of each."""
    place = np.asarray(codes, np.float64) * (len(table) - 1)
    interval = np.clip(place.astype(np.int32), 0, len(table) - 2)
    return place, interval
