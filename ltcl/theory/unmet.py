# SPDX-License-Identifier: BSD-3-Clause
"""What samples may have missed: light and weights that none of n walks has met.

An event that n samples have not met has a chance of 3 / n at most, with 95 % confidence (the rule of three:
Hanley and Lippman-Hand, 1983), and not more than that to be scored at the step in question. Of a weight w
after k steps it may hold, with a = n p_k walks that are scored there,

    a E[w^2; event] <= min(3 max w^2, sqrt(3 a E[w^4]), a E[w^2])

by Cauchy and Schwarz, of light with ordinary weights min(3, a) E[w^2].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.operators import CSR, Dense
from ltcl.operators.alias import Tables
from ltcl.operators.heaviest import heaviest, reaches
from ltcl.theory.walks import SETTLED, growth_of_weights

_UNMET = 3.0  # rule of three
_ORDINARY = 3.0  # times the root mean square: weights up to that show in the spread of samples


@dataclass(frozen=True)
class Weights:
    """Of k = 1 .. 8 steps, each (8, N): what walks weigh, without what their lengths divide it by.

    Attributes
    ----------
    squares, fourths : E[w^2], and E[w^4], infinite where float32 lost it
    largest : max w
    most : float
        The most that a step multiplies w by.
    """

    squares: np.ndarray
    fourths: np.ndarray
    largest: np.ndarray
    most: float

    def from_light(self, chosen: np.ndarray) -> Weights:
        """Of walks that start at pixel i with chance ``chosen[i]``, (N,); as of one pixel."""
        lit = chosen > 0.0
        with np.errstate(invalid="ignore", over="ignore"):
            squares, fourths = (found[:, lit] @ chosen[lit] for found in (self.squares, self.fourths))
        largest = np.max(self.largest[:, lit], axis=1, initial=0.0)
        return Weights(squares[:, None], fourths[:, None], largest[:, None], self.most)


def weights(R: CSR | Dense, made: Tables, columns: bool = False) -> list[Weights]:
    """What walks over these tables weigh, of each channel; see `growth_of_weights`. Kept with the tables."""
    if made.weights is None:
        squares = growth_of_weights(R, made, columns)
        fourths = growth_of_weights(R, made, columns, power=4)
        made.weights = [
            Weights(
                s, np.where((f > 0.0) | (s == 0.0), f, np.inf), _largest(factor, reached), float(factor.max())
            )
            for s, f, factor, reached in zip(
                squares, fourths, heaviest(R, made), reaches(R, made, columns), strict=True
            )
        ]
    return made.weights


def _largest(factor: np.ndarray, reached: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """max w of 1 .. 8 steps, (8, N): the products of a max-times algebra."""
    found = [factor]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(1, SETTLED):
            found.append(np.nan_to_num(factor * reached(found[-1]), nan=0.0, posinf=np.inf))
    return np.array(found)


def largest_square(
    w: Weights, scored: np.ndarray, worth: np.ndarray, samples: int, rare: bool = True
) -> np.ndarray:
    """Of what `samples` walks have not met: the most that it may add to the sum of squares, by |light|^2.

    Light that is met at one step alone, with ordinary weights, and weights that are not, which a walk takes
    along to all steps that follow:

        (max over k of sqrt(min(3, a_k) E[w_k^2]) |worth_k|
         + sum over k of max(0, sqrt(T_k) - 3 sqrt(min(3, a_k) E[w_k^2])) |worth_k|)^2

    with T_k the bound that stands above. Of weights within a few times their root mean square, as in
    ordinary scenes, the sum is small.

    Parameters
    ----------
    w : Weights
        Of later steps all pixels grow alike, as they did at last, and the largest by `most`.
    scored, worth : (L,)
        p_k and worth_k, of `Lengths.scores`.
    samples : int
    rare : bool
        With the sum. Of walks from light, of those that channels share and of uniform ones it is too large.

    Returns
    -------
    (N,) float64

    Examples
    --------
    >>> alike = Weights(np.full((8, 1), 0.25), np.full((8, 1), 0.0625), np.full((8, 1), 0.5), 0.5)
    >>> largest_square(alike, np.array([1.0, 0.5]), np.array([1.0, 2.0]), 100).round(9).tolist()
    [3.0]
    """
    steps, worth = len(w.squares), np.abs(worth)
    with np.errstate(over="ignore", invalid="ignore"):
        times = np.minimum(_UNMET, samples * scored) * worth**2
        found = np.max(times[:steps, None] * w.squares[: len(times)], axis=0)
        late, ratio = times[steps:], _ratio(w.squares)
        if late.size:
            later = np.arange(1, late.size + 1)
            found = np.maximum(found, w.squares[-1] * np.fmax.reduce(late * ratio**later, initial=0.0))
        if not rare:
            return found
        return (np.sqrt(found) + _of_rare_weights(w, scored, worth, samples)) ** 2


def _of_rare_weights(w: Weights, scored: np.ndarray, worth: np.ndarray, samples: int) -> np.ndarray:
    """The sum in `largest_square`; no step adds to it that fewer than 3 3^2 samples are scored at."""
    steps, found = len(w.squares), np.zeros(w.squares.shape[1])
    ratios = _ratio(w.squares), _ratio(w.fourths)
    for k in np.flatnonzero(samples * scored > _UNMET * _ORDINARY**2):
        early, more, a = min(k, steps - 1), max(0, k - steps + 1), samples * scored[k]
        squares = w.squares[early] * ratios[0] ** more
        fourths = w.fourths[early] * ratios[1] ** more
        largest = np.fmin(_UNMET * (w.largest[early] * w.most**more) ** 2, a * squares)
        rare = np.sqrt(np.fmin(largest, np.sqrt(_UNMET * a * fourths)))
        excess = rare - _ORDINARY * np.sqrt(_UNMET * squares)
        found += worth[k] * np.fmax(excess, 0.0)
    return found


def _ratio(moments: np.ndarray) -> float:
    """By which a later step multiplies them: as the last that is known."""
    return float(moments[-1].max() / (moments[-2].max() or 1.0))
