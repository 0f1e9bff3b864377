# SPDX-License-Identifier: BSD-3-Clause
"""What counts as a picture: float32, (h, w) or (h, w, 3), finite, opaque."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.errors import FileError, InputError


def as_picture(name: str, image: ArrayLike) -> np.ndarray:
    """Return `image` as contiguous float32 (h, w) or (h, w, 3); refuse other shapes, NaN and Inf."""
    array = checks.real(name, image)
    if array.ndim not in (2, 3) or array.shape[2:] not in ((), (3,)) or array.size == 0:
        raise InputError(f"{name} has shape {array.shape}; it must be (h, w) or (h, w, 3), not empty")
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(array, dtype=np.float32)
    return checks.finite(name, array)


def check_opaque(alpha: np.ndarray, opaque: int) -> None:
    """Refuse an alpha channel that is not `opaque` everywhere: what shines through a pixel is not known."""
    clear = int(np.count_nonzero(alpha != opaque))
    if clear:
        raise FileError(
            f"has {clear} transparent pixel(s), whose light is not known; "
            "remove the alpha channel (or make it opaque) first"
        )
