# SPDX-License-Identifier: BSD-3-Clause
"""The sRGB transfer curve, exact and both ways (IEC 61966-2-1).

    linear = encoded / 12.92                        for encoded <= 0.04045
    linear = ((encoded + 0.055) / 1.055) ** 2.4     above

Both directions are continued past [0, 1] as odd functions (as scRGB does), so that nothing is clipped here
and one undoes the other for every value.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks


def from_srgb(encoded: ArrayLike) -> np.ndarray:
    """Linear light of sRGB-encoded values; 0 and 1 stay where they are.

    Parameters
    ----------
    encoded
        Real numbers of any shape, 1 for white. Integer codes are to be divided by 255 or 65535 first.

    Returns
    -------
    np.ndarray
        float32, or float64 where `encoded` is; same shape.

    Raises
    ------
    InputTypeError
        `encoded` does not hold real numbers.

    Examples
    --------
    >>> float(from_srgb(np.float64(0.5)).round(4))
    0.214
    """
    value = _floating("encoded", encoded)
    size = np.abs(value)
    curve = np.where(size <= 0.04045, size / 12.92, ((size + 0.055) / 1.055) ** 2.4)
    return np.copysign(curve, value)


def to_srgb(linear: ArrayLike) -> np.ndarray:
    """Encode linear light as sRGB, the inverse of `from_srgb`.

    Parameters
    ----------
    linear
        Real numbers of any shape, 1 for white.

    Returns
    -------
    np.ndarray
        float32, or float64 where `linear` is; same shape.

    Raises
    ------
    InputTypeError
        `linear` does not hold real numbers.

    Examples
    --------
    >>> float(to_srgb(np.float64(0.214)).round(3))
    0.5
    """
    value = _floating("linear", linear)
    size = np.abs(value)
    curve = np.where(size <= 0.0031308, size * 12.92, 1.055 * size ** (1 / 2.4) - 0.055)
    return np.copysign(curve, value)


def _floating(name: str, value: ArrayLike) -> np.ndarray:
    array = checks.real(name, value)
    return array.astype(np.float64 if array.dtype == np.float64 else np.float32, copy=False)
