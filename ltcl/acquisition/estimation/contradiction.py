# SPDX-License-Identifier: BSD-3-Clause
"""Pictures that contradict all others: another light was on, or the exposure was another one.

All others foretell a picture y_m up to an error e of variance v (`regression.foretell`). A clean
picture errs where light is not as smooth as the rows of T: some pixels are too bright, some too
dark. Another light in one picture adds to all of it, and another exposure scales it. So with a
picture t of that light, white or the one that is foretold,

    strength   |<t, e>| / (|t| |white|)
    share      <t, e>^2 / (|t|^2 |e|^2), of the error
    surprise   mean of e^2 / v over pixels, relative to the median of all pictures

Where light jumps, many pictures contradict each other in this way. A picture that is wrong stands
alone: without it the rest agrees. Behind a block the coarsest patterns err most, for no others have
such light, and may stand alone as well; so a light must be stronger than T errs without its picture
for the pictures that judge T, or it is not told from that error. Many pixels are compared at the
nodes of the coarsest stage (`refinement`). `bench/faults.py --scans 200` counts the pictures that
are left out, rightly or wrongly, of random small scenes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.estimation.estimator import Estimator
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.refinement import RefinedEstimator
from ltcl.acquisition.estimation.regression import UNKNOWN_NOISE

AnyEstimator = Estimator | RefinedEstimator

# Fewest pixels at which pictures are compared: errors of less have a light's shape by chance.
MIN_PIXELS = 64
# Strength of another light that matters.
MIN_STRENGTH = 0.01
# Share of the error by another light or exposure, times surprise, from which on a picture is wrong;
# and surprise of one that is wrong in whatever way.
MAX_SHARED_SURPRISE = 2.5
MAX_SURPRISE = 20.0
# A wrong picture is so many times as far beyond these limits as any other is without it.
MIN_RATIO = 2.5
# Wrong pictures that are told from light that jumps.
MAX_WRONG = 2
# Most that a pixel counts in the surprise.
MAX_PIXEL_SURPRISE = 1e4
TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison:
    """Strength, share and surprise of each picture, (pictures,); `pixels` are those compared."""

    strength: np.ndarray
    share: np.ndarray
    surprise: np.ndarray
    pixels: int

    def contradiction(self, error: float = 0.0) -> np.ndarray:
        """Contradiction of each picture by all others, (pictures,): it may be wrong above 1.

        A light must be stronger than the error of T p.
        """
        is_light = (self.strength > max(MIN_STRENGTH, error)) & (self.pixels >= MIN_PIXELS)
        by_light = np.where(is_light, self.share * self.surprise, 0.0)
        return np.maximum(by_light / MAX_SHARED_SURPRISE, self.surprise / MAX_SURPRISE)


def find_wrong_pictures(
    pairs: Pairs,
    learn: Callable[[list[int]], AnyEstimator],
    error_without: Callable[[list[int], AnyEstimator], float],
) -> tuple[list[int], AnyEstimator]:
    """Numbers of the pairs, at most `MAX_WRONG`, whose pictures are wrong, the worst first.

    With the estimator of all others, which `learn` makes without the pairs of some numbers, and
    whose T p errs by `error_without` them for those that judge it. `pairs` begin with white, which
    no other picture is like, and which is not judged.
    """
    of_all = learn([])
    estimator = of_all
    wrong: list[int] = []
    least = np.inf
    while len(wrong) < len(pairs) - 1:
        comparison = compare_pictures(*estimator.coarsest(pairs.without(wrong)))
        contradiction = comparison.contradiction()
        worst = int(contradiction.argmax())
        largest = float(contradiction[worst])
        if wrong and least > MIN_RATIO * largest:
            return wrong, estimator
        if largest <= 1.0 or len(wrong) == MAX_WRONG:
            break
        least = min(least, largest)
        numbers = np.setdiff1d(np.arange(1, len(pairs)), wrong)
        wrong.append(int(numbers[worst]))
        estimator = learn(wrong)
        error = error_without(wrong, estimator)
        if comparison.contradiction(error)[worst] <= 1.0:
            break
    return [], of_all


def compare_pictures(estimator: Estimator, pairs: Pairs) -> Comparison:
    """Compare pictures, white first, with what all others foretell, by the priors of T."""
    sums = _Sums(len(pairs))
    for channel in range(pairs.channels):
        foretold = estimator.foretell(pairs, channel)
        seen = pairs.photographs[:, :, channel]
        is_known = np.ones(seen.shape, bool)
        if pairs.variance is not None:
            is_known = pairs.variance[:, :, channel] < UNKNOWN_NOISE
            is_known = is_known & is_known[0]
        sums.add(seen, foretold.error.T, foretold.variance.T, is_known)
    return sums.comparison()


class _Sums:
    """Sums over pixels and channels, of each picture, (pictures,)."""

    def __init__(self, pictures: int) -> None:
        self.count = np.zeros(pictures)
        self.surprise = np.zeros(pictures)
        self.error = np.zeros(pictures)
        self.white = np.zeros(pictures)
        # The part of the error that has the shape of white, and of the picture that is foretold.
        self.shared = np.zeros((2, pictures))

    def add(
        self, seen: np.ndarray, error: np.ndarray, variance: np.ndarray, is_known: np.ndarray
    ) -> None:
        """Add a channel: photographs, their errors and variances, (pictures, pixels)."""
        e = np.where(is_known, error, 0.0)
        white = np.where(is_known, seen[0], 0.0)
        foretold = np.where(is_known, seen - error, 0.0)
        self.count += is_known.sum(axis=1)
        self.surprise += np.minimum(e**2 / variance, MAX_PIXEL_SURPRISE).sum(axis=1)
        self.error += (e**2).sum(axis=1)
        self.white += (white**2).sum(axis=1)
        for number, t in enumerate((white, foretold)):
            squares = np.maximum((t**2).sum(axis=1), TINY)
            self.shared[number] += (t * e).sum(axis=1) ** 2 / squares

    def comparison(self) -> Comparison:
        """The comparison of all pictures but white."""
        shared = self.shared.max(axis=0)[1:]
        surprise = self.surprise[1:] / np.maximum(self.count[1:], 1.0)
        typical = np.median(surprise) if len(surprise) else 1.0
        return Comparison(
            strength=np.sqrt(shared / np.maximum(self.white[1:], TINY)),
            share=shared / np.maximum(self.error[1:], TINY),
            surprise=surprise / max(float(typical), TINY),
            pixels=int(self.count.max(initial=0.0)),
        )
