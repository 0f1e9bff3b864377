# SPDX-License-Identifier: BSD-3-Clause
"""The response of a camera: from codes to light, one monotone table a channel.

A table of n values over n codes equally spaced in [0, 1], linear between and beyond: codes of floats may lie
outside, and nothing is clipped. The largest code is the value 1. Tables that `calibrate` finds are 0 where
there is no light: what the camera adds to it, its black offset, makes their first values negative.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError


@dataclass(frozen=True, repr=False, eq=False)
class Response:
    """Tables from codes in [0, 1] to linear sensor values.

    Attributes
    ----------
    values : (1, n) or (3, n)
        float64, never falling, n at least 2; one serves all channels.

    Raises
    ------
    InputError
        Another shape, NaN, a table that falls or never rises.

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
            raise InputError(f"values has shape {values.shape}; it must be (1, n) or (3, n), n at least 2")
        checks.finite("values", values)
        if np.diff(values).min() < 0 or not np.all(values[:, -1] > values[:, 0]):
            raise InputError("values falls, or stays the same throughout; a response must rise")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    def __repr__(self) -> str:
        return f"Response(channels={self.channels}, n={self.values.shape[1]})"

    @classmethod
    def identity(cls) -> Response:
        """Codes that are linear already."""
        return cls(np.array([[0.0, 1.0]]))

    @property
    def channels(self) -> int:
        """1 or 3."""
        return self.values.shape[0]

    def linear(self, image: Any) -> np.ndarray:
        """Linear sensor values of codes (..., [3]) in [0, 1]; float32, same shape."""
        return self._evaluate(image, lambda table, i, part: table[i] + part * np.diff(table)[i])

    def derivative(self, image: Any) -> np.ndarray:
        """Linear value per code, at codes (..., [3]) in [0, 1]; float32, same shape."""
        return self._evaluate(image, lambda table, i, _: (np.diff(table) * (len(table) - 1))[i])

    def codes(self, linear: Any) -> np.ndarray:
        """Codes (..., [3]) that have these linear values, within [0, 1]; float32, same shape."""
        values = self._check(linear)
        grid = np.linspace(0.0, 1.0, self.values.shape[1])
        found = [np.interp(part, table, grid) for part, table in self._parts(values)]
        return self._join(found, values).astype(np.float32)

    def tables(self, levels: int) -> np.ndarray:
        """Linear values of all integer codes 0 ... levels - 1: float32, (channels, levels)."""
        codes = np.linspace(0.0, 1.0, levels)
        return np.stack([Response(table).linear(codes) for table in self.values])

    def slopes(self, count: int) -> np.ndarray:
        """Linear value per code where the linear value is 0, 1/(count - 1), ..., 1: (channels, count)."""
        at = np.linspace(0.0, 1.0, count)
        return np.stack([(one := Response(table)).derivative(one.codes(at)) for table in self.values])

    def to_arrays(self) -> dict[str, np.ndarray]:
        """What `from_arrays` takes."""
        return {"response": self.values}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Response:
        """The response that `to_arrays` was called of."""
        return cls(arrays["response"])

    def _check(self, image: Any) -> np.ndarray:
        codes = checks.real("image", image)
        if codes.dtype.kind != "f":
            raise InputError(f"image holds {codes.dtype}; codes must be floats, 1 for the largest")
        if self.channels == 3 and codes.shape[-1:] != (3,):
            raise InputError(f"image has shape {codes.shape}; this response needs (..., 3)")
        return codes

    def _parts(self, image: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        parts = [image] if self.channels == 1 else list(np.moveaxis(image, -1, 0))
        return list(zip(parts, self.values, strict=True))

    def _join(self, parts: list[np.ndarray], like: np.ndarray) -> np.ndarray:
        return np.stack(parts, axis=-1) if self.channels == 3 else parts[0].reshape(like.shape)

    def _evaluate(self, image: Any, value: Any) -> np.ndarray:
        codes, n = self._check(image), self.values.shape[1]
        found = []
        for part, table in self._parts(codes):
            place = np.asarray(part, np.float64) * (n - 1)
            i = np.clip(place.astype(np.int32), 0, n - 2)
            found.append(value(table, i, place - i).astype(np.float32))
        return self._join(found, codes)
