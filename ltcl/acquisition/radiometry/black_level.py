# SPDX-License-Identifier: BSD-3-Clause
"""Level of a camera without light, from photographs of a scene under a black projector.

Pixel p has the linear value b + a_p t_k after t_k seconds: a level b of its channel, and ambient
light a_p. By least squares with weights w_k of the mean of each photograph

    b = sum_p (Y0 - Y1 S1 / S2) / sum_p (S0 - S1^2 / S2)
    Sn = sum_k w_k t_k^n,    Yn = sum_k w_k t_k^n y_pk
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl.acquisition.radiometry.exposures import MAX_PIXELS, exposure_stack
from ltcl.acquisition.radiometry.noise import NoiseModel, choose_levels
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError


def black_level(
    images: Sequence[Any],
    seconds: Any,
    response: Response,
    noise: NoiseModel,
    *,
    levels: int | None = None,
) -> np.ndarray:
    """Linear value of a camera without light: the `black` of `merge`.

    Parameters
    ----------
    images : sequence of (H, W) or (H, W, 3) arrays
        Photographs as in `merge`, under a black projector.
    seconds : sequence of float
        Their exposures, at least two different ones.
    response : Response
        Response of the camera.
    noise : NoiseModel
        Noise of the camera; its `black` is not used.
    levels : int, optional
        Number of codes of the camera; None for that of the noise model, or all of the type.

    Returns
    -------
    (channels,) float64

    Raises
    ------
    InputError
        As in `merge`; also for one exposure only, and if every pixel is saturated in some
        photograph.

    Examples
    --------
    >>> from ltcl.acquisition.radiometry import Response
    >>> shots = [0.01 + t * np.array([[0.0, 0.1, 0.2]]) for t in (0.5, 1.0, 2.0)]
    >>> black_level(shots, [0.5, 1.0, 2.0], Response.identity(), NoiseModel()).round(4)
    array([0.01])
    """
    stack = exposure_stack(images, seconds, choose_levels(levels, noise))
    stack.check_different_exposures(seconds)
    light = response.linear(stack.codes(MAX_PIXELS))
    channels = light.shape[2]
    level = np.empty(channels)
    for c in range(channels):
        is_clear = light[..., c].max(axis=0) <= noise.saturation
        y = light[:, is_clear, c].astype(np.float64)
        if y.shape[1] == 0:
            raise InputError(
                "images are saturated at every pixel; they need shorter exposures or less light"
            )
        level[c] = _intercept(stack.seconds, y, noise)
    return level


def _intercept(t: np.ndarray, y: np.ndarray, noise: NoiseModel) -> float:
    """The common value at 0 seconds of the lines through y (K, pixels) at t (K,)."""
    w = 1.0 / noise.variance(y.mean(axis=1))
    S0 = float(np.sum(w))
    S1 = float(np.sum(w * t))
    S2 = float(np.sum(w * t**2))
    pixels = y.shape[1]
    return np.sum((w - w * t * (S1 / S2)) @ y) / (pixels * (S0 - S1**2 / S2))
