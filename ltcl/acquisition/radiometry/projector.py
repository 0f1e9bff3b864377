# SPDX-License-Identifier: BSD-3-Clause
"""The response of a projector: from the codes that it is fed to the light that it sends.

Under a uniform code c camera pixel p has the radiance L_p(c) = a_p + g(c) s_p: what is there at code 0, and
its share of the projector's light, whatever way that took. With a_p = L_p(0), s_p = L_p(1) - L_p(0),

    g(c) = sum_p w_p (s_p (L_p(c) - a_p) - V_p(0)) / sum_p w_p (s_p^2 - V_p(0) - V_p(1))

where V are the variances of L, which the products have as a bias, and w_p = 1 / (V_p(0) + V_p(1)). g is made
monotone by isotonic regression and continued between the codes by a monotone cubic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.optimize
from scipy.interpolate import PchipInterpolator

from ltcl import checks
from ltcl.acquisition.radiometry.merge import Radiance
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import NO_LIGHT
from ltcl.errors import InputError, InputTypeError

_TABLE = 1025  # four values for each code of 8 bits
_SIGNIFICANT = 3.0  # standard errors that white must be above black: one black projector in 700 passes


@dataclass(frozen=True, repr=False, eq=False)
class ProjectorResponse(Response):
    """Tables from codes in [0, 1] to linear light in [0, 1], as those of a camera.

    `linear(codes)` is the light of codes and `codes(linear)` the way back, to be fed to the projector.

    Examples
    --------
    >>> gamma = ProjectorResponse(np.linspace(0, 1, 1025) ** 2.0)
    >>> gamma.codes(np.array([[0.0, 0.25, 1.0]]))
    array([[0. , 0.5, 1. ]], dtype=float32)
    """


def measure(codes: Any, pictures: Sequence[Any]) -> ProjectorResponse:
    """The response from merged pictures of uniform codes.

    Parameters
    ----------
    codes : (n,)
        Rising from 0 to 1; 17 to 33 of them.
    pictures : sequence of n Radiance, or 3 such sequences
        Of the scene under each code, in all channels of the projector at once: one response. Of three
        sequences each has one channel of the projector lit: a response for each.

    Raises
    ------
    InputError, InputTypeError
        Codes that do not rise from 0 to 1, another number of pictures than codes, pictures of mixed shapes,
        a projector whose white is as dark as its black.

    Examples
    --------
    >>> codes, ones = np.linspace(0, 1, 5), np.ones((2, 2))
    >>> pictures = [Radiance(0.1 + 0.5 * c**2 * ones, 1e-6 * ones, ones > 0) for c in codes]
    >>> measure(codes, pictures).linear(codes).round(4)
    array([0.    , 0.0625, 0.25  , 0.5625, 1.    ], dtype=float32)
    """
    levels = checks.finite("codes", checks.real("codes", codes).astype(np.float64))
    if levels.ndim != 1 or len(levels) < 2 or np.any(np.diff(levels) <= 0) or levels[0] or levels[-1] != 1:
        raise InputError(f"codes is {codes!r}; it must rise from 0 to 1")
    if len(pictures) == 3 and not isinstance(pictures[0], Radiance):
        tables = [_table(levels, channel, f"pictures[{c}]") for c, channel in enumerate(pictures)]
        return ProjectorResponse(np.stack(tables))
    return ProjectorResponse(_table(levels, pictures, "pictures"))


def _table(codes: np.ndarray, pictures: Sequence[Any], name: str) -> np.ndarray:
    if len(pictures) != len(codes):
        raise InputError(
            f"{name} holds {len(pictures)} picture(s); it must hold {len(codes)}, one for each code"
        )
    for k, picture in enumerate(pictures):
        if not isinstance(picture, Radiance):
            raise InputTypeError(f"{name}[{k}] is a {type(picture).__name__}; it must be a Radiance")
        checks.shape(f"{name}[{k}]", picture.value, pictures[0].value.shape)
    seen = np.all([picture.valid for picture in pictures], axis=0)
    if not seen.any():
        raise InputError(f"{name} have no pixel that is valid under all codes; other exposures are needed")
    L = np.stack([picture.value[seen] for picture in pictures]).astype(np.float64)
    dark, bright = (pictures[k].variance[seen].astype(np.float64) for k in (0, -1))
    w, s = 1.0 / np.maximum(dark + bright, 1e-300), L[-1] - L[0]
    # Not weighted: colours that a channel does not light have next to no variance, and would decide alone.
    if np.sum(s) < _SIGNIFICANT * np.sqrt(np.sum(dark + bright)):
        raise InputError(f"{name} are no brighter under code 1 than under code 0; {NO_LIGHT}")
    above = (L[1:-1] - L[0]) * s - dark
    g = (above @ w) / np.sum(w * (s**2 - dark - bright))
    rising = scipy.optimize.isotonic_regression(np.concatenate([[0.0], np.clip(g, 0.0, 1.0), [1.0]])).x
    table = PchipInterpolator(codes, rising)(np.linspace(0.0, 1.0, _TABLE))
    return np.maximum.accumulate(np.clip(table, 0.0, 1.0))
