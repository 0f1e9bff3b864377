# SPDX-License-Identifier: BSD-3-Clause
"""Standard errors of sampled pixels: 0 where that is certain, NaN where samples do not tell."""

from __future__ import annotations

import functools

import numpy as np

from ltcl.device import Array
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import Tables
from ltcl.operators.certainty import reached, without_noise
from ltcl.operators.entrywise import squares
from ltcl.operators.walks import Lengths, Sums


class Noise:
    """Of walks over R with these tables and lengths, to or from `b`; see `without_noise`.

    What is certain is found when the samples of a pixel are all alike for the first time.
    """

    def __init__(self, R: CSR | Dense, made: Tables, lengths: Lengths, b: Array, only_dark: bool) -> None:
        self._walks = (R, made, lengths, b, only_dark)

    def errors(self, sums: Sums, pixels: np.ndarray) -> np.ndarray:
        """Of the means of `pixels`, like these."""
        found, alike = sums.standard_error, sums.alike
        if not alike.any():
            return found
        return np.where(self._certain[pixels], 0.0, np.where(alike, np.nan, found))

    @functools.cached_property
    def _certain(self) -> np.ndarray:
        R, made, lengths, b, only_dark = self._walks
        return without_noise(R, made, lengths, b.get(), only_dark)


def gathered(R: CSR | Dense, error: np.ndarray) -> np.ndarray:
    """Standard errors of R x by those of x, whose errors are independent: variances pass through squares.

    >>> import ltcl
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [0.0, 0.25]])
    >>> gathered(R, np.array([np.nan, 4.0])).tolist(), gathered(R, np.array([4.0, np.nan])).tolist()
    ([2.0, 1.0], [nan, nan])
    """
    found = np.sqrt(np.asarray(squares(R) @ np.nan_to_num(error, nan=0.0) ** 2))
    unknown = np.isnan(error)
    if unknown.any():
        found[reached(R, unknown.reshape(len(error), -1), 1).reshape(error.shape)] = np.nan
    return found
