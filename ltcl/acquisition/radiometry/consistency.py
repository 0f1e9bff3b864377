# SPDX-License-Identifier: BSD-3-Clause
"""Whether photographs, their seconds and a response agree: ratios of light against ratios of seconds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.stack import stack

_LOW, _HIGH = 0.05, 0.95  # light that a photograph tells well


def consistency(
    images: Sequence[Any], seconds: Any, response: Response, *, levels: int | None = None
) -> np.ndarray:
    """How far ratios of light are from ratios of seconds, for each pair of neighbouring exposures.

    Parameters
    ----------
    images, seconds, levels
        As in `calibrate`.
    response : Response

    Returns
    -------
    np.ndarray
        (K - 1, channels, 3), shortest pair first: median and spread (1.4826 median absolute deviations) of
        log(light_2 / light_1) - log(seconds_2 / seconds_1), and the share of pixels that tell it: those with
        light above 0.05 in the shorter and below 0.95 in the longer. NaN where there are none.

    Examples
    --------
    >>> shots = [np.linspace(0.1, 0.4, 200).reshape(10, 20) * t for t in (1, 2)]
    >>> abs(consistency(shots, [1, 2], Response.identity()).round(6)).tolist()
    [[[0.0, 0.0, 1.0]]]
    """
    bracket = stack(images, seconds, levels)
    light = [response.linear(bracket.codes(k)) for k in range(len(bracket.images))]
    found = np.full((len(light) - 1, bracket.channels, 3), np.nan)
    for k, c in np.ndindex(found.shape[:2]):
        short, long = light[k][:, c], light[k + 1][:, c]
        seen = (short > _LOW) & (long < _HIGH)
        found[k, c, 2] = seen.mean()
        if seen.any():
            off = np.log(long[seen] / short[seen]) - np.log(bracket.seconds[k + 1] / bracket.seconds[k])
            middle = np.median(off)
            found[k, c, :2] = middle, 1.4826 * np.median(np.abs(off - middle))
    return found
