# SPDX-License-Identifier: BSD-3-Clause
"""Standard errors of sampled pixels: of the light that samples have met, and of that which they have not.

Samples tell nothing of a light that none of them has met, however bright it is. But then its chance is at
most about 3 / n of n samples, and so its share of the variance of a mean at most

    3 (W_i max |b|)^2 / n^2,    W_i the root mean square of what a score is worth by its light

and likewise of weights, where some of what walks may meet multiplies them by far more than the rest
(`ltcl.theory.unmet.largest_square`). That is added to s^2 / n, the estimate by the samples' own spread s, but
where there is no noise for certain. Of pictures with ordinary contrast it is a few hundredths of it; where
few samples have met the light, or none, it is most of it.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from ltcl.operators import CSR, Dense
from ltcl.operators.alias import Tables
from ltcl.operators.certainty import reached, without_noise
from ltcl.operators.entrywise import squares
from ltcl.operators.links import Links
from ltcl.operators.walks import Lengths, Sums
from ltcl.solvers.sampled import side_by_side
from ltcl.theory.unmet import Weights, largest_square, weights


class Noise:
    """Of walks with these tables and lengths, to or from light; see `without_noise`.

    What is certain is found when the samples of a pixel are all alike for the first time. Where colour
    channels share walks it is found for each by the entries of its own R, since its weight is 0 elsewhere,
    and by the choices that the shared rows leave.

    Parameters
    ----------
    channels : R and light, (N,) or (N, k), of each
    made, lengths
        As of `without_noise`.
    estimator : str
    adjoint : bool
        Walks from light.
    """

    def __init__(
        self,
        channels: Sequence[tuple[CSR | Dense, np.ndarray]],
        made: Tables,
        lengths: Lengths,
        estimator: str,
        adjoint: bool = False,
    ) -> None:
        self._channels, self._made, self._lengths = channels, made, lengths
        self._estimator, self._adjoint = estimator, adjoint

    def errors(self, sums: Sums, pixels: np.ndarray) -> np.ndarray:
        """Of the means of `pixels`, (P, columns): those of the channels side by side.

        NaN of a single sample.
        """
        alike = sums.alike
        if sums.samples < 2:
            found = np.where(alike, np.nan, sums.standard_error)
        else:
            found = np.hypot(sums.standard_error, self._unmet(sums.samples, pixels) / sums.samples)
        return np.where(self._certain[pixels], 0.0, found) if alike.any() else found

    def _unmet(self, samples: int, pixels: np.ndarray) -> np.ndarray:
        """Root of the squares that may be added by what no sample has met, (P, columns)."""
        scores = self._lengths.scores(self._estimator)
        rare = not isinstance(self._made, Links) and self._made.sampler != "uniform"
        found = []
        for w, (_, light) in zip(
            weights(self._channels[0][0], self._made, self._adjoint), self._channels, strict=True
        ):
            bright = np.abs(light)
            if self._adjoint:
                found.append(_from(bright, w, scores, samples)[pixels])
            else:
                root = np.sqrt(largest_square(w, *scores, samples, rare))[pixels]
                found.append(np.multiply.outer(root, bright.max(axis=0)))
        return side_by_side(found)

    @functools.cached_property
    def _certain(self) -> np.ndarray:
        only_dark = self._estimator == "endpoint"
        found = [without_noise(R, self._made, self._lengths, light, only_dark) for R, light in self._channels]
        return side_by_side(found)


def _from(bright: np.ndarray, w: Weights, scores: tuple[np.ndarray, np.ndarray], samples: int) -> np.ndarray:
    """Of walks that begin in proportion to the light, (N,) or (N, k), each with the weight of all of it."""
    columns = bright.reshape(len(bright), -1).astype(np.float64).T
    whole = columns.sum(axis=1, keepdims=True)
    chosen = columns / np.where(whole > 0.0, whole, 1.0)
    roots = [np.sqrt(largest_square(w.from_light(one), *scores, samples, rare=False)) for one in chosen]
    return np.broadcast_to((whole * roots).reshape(bright.shape[1:]), bright.shape)


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
