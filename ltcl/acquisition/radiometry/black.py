# SPDX-License-Identifier: BSD-3-Clause
"""What a camera records without light, and the light that is there without the projector.

Under a black projector the linear value of pixel p after t_k seconds is b + a_p t_k: an offset b of the
camera, one a channel, and ambient light a_p (with what the projector leaks at code 0). Least squares with
weights w_k of the mean light of each photograph, a_p eliminated:

    b = sum_p (Y0 - Y1 S1 / S2) / sum_p (S0 - S1^2 / S2),    Sn = sum_k w_k t_k^n,  Yn = sum_k w_k t_k^n y_pk

Both are signed: black is subtracted, never the size of a difference taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ltcl.acquisition.radiometry.merge import Radiance, merge
from ltcl.acquisition.radiometry.noise import NoiseModel
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import stack
from ltcl.errors import InputError


@dataclass(frozen=True, repr=False, eq=False)
class Black:
    """Result of `measure`.

    Attributes
    ----------
    offset, error : (channels,)
        Linear value without light, the `black` of `merge`, and its standard error; float64.
    ambient : Radiance
        Of the scene without the projector: to be subtracted from each merged picture.
    """

    offset: np.ndarray
    error: np.ndarray
    ambient: Radiance


def measure(
    images: Sequence[Any],
    seconds: Any,
    response: Response | None = None,
    noise: NoiseModel | None = None,
    *,
    levels: int | None = None,
) -> Black:
    """Offset of the camera and ambient light, from photographs under a black projector.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3)
        At two different exposures at least; repeated ones are averaged.
    seconds : (K,)
        Of each photograph, in any order.
    response, noise, levels
        As in `merge`; the black of `noise` is not used.

    Raises
    ------
    InputError
        What `merge` refuses; one exposure only; no pixel that no photograph saturates.

    Examples
    --------
    >>> shots = [0.01 + t * np.array([[0.0, 0.1, 0.2]]) for t in (0.5, 1.0, 2.0)]
    >>> black = measure(shots, [0.5, 1.0, 2.0])
    >>> black.offset.round(4), black.ambient.value.round(4)
    (array([0.01]), array([[0. , 0.1, 0.2]], dtype=float32))
    """
    response, noise = response or Response.identity(), replace(noise or NoiseModel(), black=0.0)
    bracket = stack(images, seconds, levels or noise.levels or None)
    t = bracket.seconds
    if t[0] == t[-1]:
        raise InputError(
            f"seconds is {seconds!r}: an offset and ambient light need two different exposures at least"
        )
    light = np.stack([response.linear(bracket.codes(k)) for k in range(len(t))])
    offset, error = np.empty(bracket.channels), np.empty(bracket.channels)
    for c in range(bracket.channels):
        y = light[:, light[..., c].max(axis=0) <= noise.saturation, c].astype(np.float64)
        if y.shape[1] == 0:
            raise InputError("images are saturated at every pixel; take shorter ones, or less ambient light")
        w = 1.0 / noise.variance(y.mean(axis=1))
        S0, S1, S2 = (float(np.sum(w * t**n)) for n in range(3))
        information = y.shape[1] * (S0 - S1**2 / S2)
        offset[c] = np.sum((w - w * t * (S1 / S2)) @ y) / information
        error[c] = information**-0.5
    ambient = merge(images, seconds, response, noise, levels=bracket.levels or None, black=offset)
    return Black(offset, error, ambient)
