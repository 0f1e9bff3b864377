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
from ltcl.acquisition.radiometry.stack import Stack, levels_of, normalised, photographs, stack
from ltcl.errors import InputError


@dataclass(frozen=True, repr=False, eq=False)
class Black:
    """Found by `measure`.

    Attributes
    ----------
    offset : (channels,)
        Linear value without light, float64: the `black` of `merge`.
    error : (channels,)
        Its standard error.
    ambient : Radiance
        Of the scene without the projector: to be subtracted from each merged picture.
    """

    offset: np.ndarray
    error: np.ndarray
    ambient: Radiance


def average(
    frames: Sequence[Any], response: Response | None = None, *, levels: int | None = None
) -> np.ndarray:
    """Mean linear value of each pixel over photographs without light, as the `black` of `merge`.

    Parameters
    ----------
    frames : sequence of (H, W) or (H, W, 3)
        With the lens covered, at the longest exposure, of which dark current has most.
    response : Response, optional
        None for linear codes.
    levels : int, optional
        As in `merge`.

    Returns
    -------
    np.ndarray
        float32, as one frame. Linear values are averaged, not codes: a mean of codes is off where the
        response bends.

    Raises
    ------
    InputError
        No frames, mixed shapes or types, NaN.

    Examples
    --------
    >>> average([np.full((1, 2), 0.010), np.full((1, 2), 0.014)]).round(4)
    array([[0.012, 0.012]], dtype=float32)
    """
    shots = photographs("frames", frames)
    levels = levels_of(shots, levels)
    response = response or Response.identity()
    total = np.zeros(shots[0].shape)
    for shot in shots:
        total += response.linear(normalised(shot, levels))
    return (total / len(shots)).astype(np.float32)


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
        At two different exposures at least, the longest as often as it takes: frames are averaged.
    seconds : (K,)
        Of each photograph, in any order.
    response, noise, levels
        As in `merge`; the black of `noise` is not used.

    Raises
    ------
    InputError
        What `stack` refuses; one exposure only; no pixel that no photograph saturates.

    Examples
    --------
    >>> shots = [0.01 + t * np.array([[0.0, 0.1, 0.2]]) for t in (0.5, 1.0, 2.0)]
    >>> found = measure(shots, [0.5, 1.0, 2.0])
    >>> found.offset.round(4), found.ambient.value.round(4)
    (array([0.01]), array([[0. , 0.1, 0.2]], dtype=float32))
    """
    response, noise = response or Response.identity(), replace(noise or NoiseModel(), black=0.0)
    bracket = stack(images, seconds, levels or noise.levels or None)
    if bracket.seconds[0] == bracket.seconds[-1]:
        raise InputError(
            f"seconds is {seconds!r}: telling an offset from ambient light needs two different exposures"
        )
    light = np.stack([response.linear(bracket.codes(k)) for k in range(len(bracket.images))])
    found = [_offset(light[..., c], bracket, noise) for c in range(bracket.channels)]
    offset, error = np.array(found).T
    ambient = merge(images, seconds, response, noise, levels=bracket.levels or None, black=offset)
    return Black(offset, error, ambient)


def _offset(light: np.ndarray, bracket: Stack, noise: NoiseModel) -> tuple[float, float]:
    """Offset of light (K, P), and its standard error."""
    y = light[:, light.max(axis=0) <= noise.saturation].astype(np.float64)
    if y.shape[1] == 0:
        raise InputError("images are saturated at every pixel; take shorter ones, or less ambient light")
    w = 1.0 / noise.variance(y.mean(axis=1))
    S0, S1, S2 = (float(np.sum(w * bracket.seconds**n)) for n in range(3))
    Y0, Y1 = w @ y, (w * bracket.seconds) @ y
    told = y.shape[1] * (S0 - S1**2 / S2)
    return float(np.sum(Y0 - Y1 * (S1 / S2)) / told), told**-0.5
