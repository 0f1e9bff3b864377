# SPDX-License-Identifier: BSD-3-Clause
"""Standard errors of sampled pixels: 0 where that is certain, NaN where samples do not tell."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from ltcl.operators import CSR, Dense
from ltcl.operators.alias import Tables
from ltcl.operators.certainty import reached, without_noise
from ltcl.operators.entrywise import squares
from ltcl.operators.walks import Lengths, Sums
from ltcl.solvers.sampled import side_by_side


class Noise:
    """Of walks with these tables and lengths, to or from light; see `without_noise`.

    What is certain is found when the samples of a pixel are all alike for the first time. Where colour
    channels share walks it is found for each by the entries of its own R, since its weight is 0 elsewhere,
    and by the choices that the shared rows leave.

    Parameters
    ----------
    channels : R and light, (N,) or (N, k), of each
    made, lengths, only_dark
        As of `without_noise`.
    """

    def __init__(
        self,
        channels: Sequence[tuple[CSR | Dense, np.ndarray]],
        made: Tables,
        lengths: Lengths,
        only_dark: bool,
    ) -> None:
        self._channels, self._walks = channels, (made, lengths, only_dark)

    def errors(self, sums: Sums, pixels: np.ndarray) -> np.ndarray:
        """Of the means of `pixels`, (P, columns): those of the channels side by side."""
        found, alike = sums.standard_error, sums.alike
        if not alike.any():
            return found
        return np.where(self._certain[pixels], 0.0, np.where(alike, np.nan, found))

    @functools.cached_property
    def _certain(self) -> np.ndarray:
        made, lengths, only_dark = self._walks
        found = [without_noise(R, made, lengths, light, only_dark) for R, light in self._channels]
        return side_by_side(found)


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
