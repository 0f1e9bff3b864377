# SPDX-License-Identifier: BSD-3-Clause
"""Response curves as tables: linear light at equally spaced codes, one table for each channel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError


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
        values = np.atleast_2d(checks.real("values", self.values)).astype(np.float64)
        if values.ndim != 2 or values.shape[0] not in (1, 3) or values.shape[1] < 2:
            raise InputError(
                f"values has shape {values.shape}; it must be (1, n) or (3, n), n at least 2"
            )
        checks.finite("values", values)
        if np.diff(values).min() < 0 or not np.all(values[:, -1] > values[:, 0]):
            raise InputError("values falls, or stays the same throughout; a response must rise")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(channels={self.channels}, n={self.values.shape[1]})"

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
        planes = [_interpolate(codes, table) for codes, table in self._channels(image)]
        return self._join(planes)

    def derivative(self, image: Any) -> np.ndarray:
        """Linear value per code, at codes (..., [3]) in [0, 1]; float32, same shape."""
        planes = [_slope(codes, table) for codes, table in self._channels(image)]
        return self._join(planes)

    def codes(self, linear: Any) -> np.ndarray:
        """Codes (..., [3]) that have these linear values, within [0, 1]; float32, same shape."""
        codes = np.linspace(0, 1, self.values.shape[1])
        planes = [np.interp(light, table, codes) for light, table in self._channels(linear)]
        return self._join(planes)

    def _channels(self, image: Any) -> list[tuple[np.ndarray, np.ndarray]]:
        """Pairs of a plane and its table: one for each channel, or one for the whole image."""
        array = checks.real("image", image)
        if array.dtype.kind != "f":
            raise InputError(f"image holds {array.dtype}; codes must be floats, 1 for the largest")
        if self.channels == 1:
            return [(array, self.values[0])]
        if array.shape[-1:] != (3,):
            raise InputError(f"image has shape {array.shape}; this response needs (..., 3)")
        return [(array[..., c], table) for c, table in enumerate(self.values)]

    def _join(self, planes: list[np.ndarray]) -> np.ndarray:
        """The inverse of `_channels`: float32 of the shape of the image."""
        if self.channels == 1:
            return np.asarray(planes[0], np.float32)
        return np.stack(planes, axis=-1).astype(np.float32)


def _interpolate(codes: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Values at codes, which may lie beyond the ends of the table."""
    place, interval = _intervals(codes, table)
    return table[interval] + (place - interval) * np.diff(table)[interval]


def _slope(codes: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Slope of the table at codes, which may lie beyond its ends."""
    _, interval = _intervals(codes, table)
    return (len(table) - 1) * np.diff(table)[interval]


def _intervals(codes: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of codes among the values of the table, and the interval of each."""
    place = np.asarray(codes, np.float64) * (len(table) - 1)
    interval = np.clip(place.astype(np.int32), 0, len(table) - 2)
    return place, interval
