# SPDX-License-Identifier: BSD-3-Clause
"""The response of a projector, from codes to light, and how its colours mix in the channels of a camera.

Under a uniform code c camera pixel p has the radiance L_p(c) = a_p + g(c) s_p: what is there at
code 0, and its share of the projector's light, whatever way that took. With a_p = L_p(0), s_p =
L_p(1) - L_p(0),

    g(c) = sum_p w_p (s_p (L_p(c) - a_p) - V_p(0)) / sum_p w_p (s_p^2 - V_p(0) - V_p(1))

where V are the variances of L, the bias of the products, and w_p = 1 / (V_p(0) + V_p(1)). Isotonic
regression makes g monotone; between the codes it is a monotone cubic.

With channel d of the projector lit alone, channel c of the camera has the radiance L_cd(p) above
black. The mixing is relative to a channel's own light, as `ltcl.Transport(mixing=)` takes it: M_cc
= 1,

    M_cd = sum_p w_p L_cd L_cc / sum_p w_p (L_cc^2 - V_cc),    w_p = 1 / (V_cd + V_cc)

one for the set-up. Known limit: it is the mean over surfaces, but what mixes depends on their
spectra, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.optimize
from scipy.interpolate import PchipInterpolator

from ltcl import checks
from ltcl.acquisition.radiometry.camera import NO_LIGHT
from ltcl.acquisition.radiometry.merge import Radiance
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError
from ltcl.transport.matrices import check_mixing

_TABLE = 1025  # four values for each code of 8 bits
_SIGNIFICANT = (
    3.0  # standard errors that white must be above black: one black projector in 700 passes
)


def projector_response(codes: Any, channels: Sequence[Sequence[Radiance]]) -> Response:
    """The response from merged pictures of the scene under uniform codes, which rise from 0 to 1.

    `channels` holds one sequence of pictures, with all channels of the projector lit at once, or
    three, each with one of them. InputError for other codes, another number of pictures, and white
    as dark as black.

    >>> codes, ones = np.linspace(0, 1, 5), np.ones((2, 2))
    >>> pictures = [Radiance(0.1 + 0.5 * c**2 * ones, 1e-6 * ones, ones > 0) for c in codes]
    >>> projector_response(codes, [pictures]).linear(codes).round(4)
    array([0.    , 0.0625, 0.25  , 0.5625, 1.    ], dtype=float32)
    """
    levels = checks.finite("codes", checks.real("codes", codes).astype(np.float64))
    if (
        levels.ndim != 1
        or len(levels) < 2
        or np.any(np.diff(levels) <= 0)
        or levels[0]
        or levels[-1] != 1
    ):
        raise InputError(f"codes is {codes!r}; it must rise from 0 to 1")
    tables = [_table(levels, pictures, f"channels[{c}]") for c, pictures in enumerate(channels)]
    return Response(np.stack(tables))


def _table(codes: np.ndarray, pictures: Sequence[Radiance], name: str) -> np.ndarray:
    """The response to `_TABLE` codes."""
    if len(pictures) != len(codes):
        raise InputError(
            f"{name} holds {len(pictures)} picture(s); it must hold {len(codes)}, one a code"
        )
    seen = np.all([picture.valid for picture in pictures], axis=0)
    if not seen.any():
        raise InputError(
            f"{name} have no pixel that is valid under all codes; other exposures are needed"
        )
    L = np.stack([picture.value[seen] for picture in pictures]).astype(np.float64)
    dark, bright = (pictures[k].variance[seen].astype(np.float64) for k in (0, -1))
    w, s = 1.0 / np.maximum(dark + bright, 1e-300), L[-1] - L[0]
    # Not weighted: colours that a channel does not light have next to no variance, and would decide
    # alone.
    if np.sum(s) < _SIGNIFICANT * np.sqrt(np.sum(dark + bright)):
        raise InputError(f"{name} are no brighter under code 1 than under code 0; {NO_LIGHT}")
    above = (L[1:-1] - L[0]) * s - dark
    g = (above @ w) / np.sum(w * (s**2 - dark - bright))
    rising = scipy.optimize.isotonic_regression(
        np.concatenate([[0.0], np.clip(g, 0.0, 1.0), [1.0]])
    ).x
    table = PchipInterpolator(codes, rising)(np.linspace(0.0, 1.0, _TABLE))
    return np.maximum.accumulate(np.clip(table, 0.0, 1.0))


def mixing(lit: Sequence[Radiance], black: Radiance) -> np.ndarray:
    """The mixing of colours (3, 3), from 3 pictures (H, W, 3) under red, green and blue, and one under black.

    Rows are channels of the camera. InputError for other numbers or shapes, a channel without light
    of its own colour, and a mixing that cannot be undone (condition number above 1e6).

    >>> M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    >>> ones = np.ones((4, 5, 3))
    >>> pictures = [Radiance(ones * M[:, d], 1e-8 * ones, ones > 0) for d in range(3)]
    >>> bool(np.allclose(mixing(pictures, Radiance(0 * ones, 1e-8 * ones, ones > 0)), M))
    True
    """
    if len(lit) != 3:
        raise InputError(
            f"lit holds {len(lit)} picture(s); it must hold three: under red, green and blue"
        )
    for name, picture in zip(("lit[0]", "lit[1]", "lit[2]", "black"), (*lit, black), strict=True):
        checks.shape(name, picture.value, (*black.value.shape[:2], 3))
    pictures = [picture - black for picture in lit]
    valid = np.all([picture.valid for picture in pictures], axis=(0, 3))
    if not valid.any():
        raise InputError("lit have no pixel that is valid in all; other exposures are needed")
    # (pixels, camera, projector)
    L = np.stack([picture.value[valid] for picture in pictures], axis=-1).astype(np.float64)
    V = np.stack([picture.variance[valid] for picture in pictures], axis=-1).astype(np.float64)
    M = np.eye(3)
    for c, d in np.argwhere(~np.eye(3, dtype=bool)):
        w = 1.0 / np.maximum(V[:, c, d] + V[:, c, c], 1e-300)
        own = np.sum(w * (L[:, c, c] ** 2 - V[:, c, c]))
        if own <= 0:
            raise InputError(
                f"lit[{c}] has no light in its own channel {c}; is the order red, green, blue?"
            )
        M[c, d] = np.sum(w * L[:, c, d] * L[:, c, c]) / own
    return check_mixing(M, 3, has_blocks=False)
