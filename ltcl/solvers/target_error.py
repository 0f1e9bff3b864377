# SPDX-License-Identifier: BSD-3-Clause
"""Sampling until the standard error of every pixel is as small as wanted, in stages.

Each stage draws fresh samples, as many as the stage before it says are needed, and with some to spare; only
the last stage of a pixel counts. Samples chosen by their own spread would be biased: where few of them have
met light, those that met none seem best.

A spread is worth nothing where few samples carry its squares (`Sums.doubt`), and the light that they have
not met (`ltcl.solvers.noise`) is not as much again: then the next stage has four times the samples, whatever
the spread says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.device import Array
from ltcl.operators.walks import Sums, Walker

MOST = 1 << 20  # samples of a stage
_FIRST = 512  # of the first; of fewer, too few chunks tell how far to believe the spread
_GROWTH = 4
_DOUBT = 0.25  # relative error of a sum of squares that is believed: of a standard error half as much
Measured = Callable[[Sums, np.ndarray], np.ndarray]
_STREAMS = (1, 0)  # of the stages; those after have their own numbers


@dataclass(frozen=True)
class Staged:
    """What was found for each of P pixels.

    Attributes
    ----------
    mean, standard_error : (P,) or (P, k)
    met : (P,) bool
        Whether the error is as small as wanted, by enough samples that say so.
    samples : (P,) int64
        Of all stages.
    """

    mean: np.ndarray
    standard_error: np.ndarray
    met: np.ndarray
    samples: np.ndarray

    @classmethod
    def fixed(cls, sums: Sums, standard: np.ndarray) -> Staged:
        """Of a number of samples that was given, with nothing to be met."""
        pixels = len(standard)
        return cls(sums.mean, standard, np.ones(pixels, bool), np.full(pixels, sums.samples))

    def told(self, met: np.ndarray, error: float, most: int, instead: str, by: str = "") -> str:
        """How many pixels met the error, (P,) bool, what they took, and what to try where some did not."""
        spent = f"{self.samples.mean():.3g} samples a pixel, {self.samples.sum():.3g} in all"
        if met.all():
            return f"error={error:g} met by {by}{spent}"
        missed = f"{np.sum(~met)} of {len(met)} pixels missed error={error:g} within {most} samples"
        return f"{missed}: {instead} ({spent})"

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Staged:
        """To be filled, pixel by pixel."""
        pixels = shape[:1]
        return cls(np.zeros(shape), np.zeros(shape), np.zeros(pixels, bool), np.zeros(pixels, np.int64))


def sample_to(
    walker: Walker,
    b: Array,
    pixels: np.ndarray,
    error: np.ndarray,
    most: int,
    measured: Measured,
) -> Staged:
    """Estimates whose standard error is at most `error`, (k,), or of `most` samples in the last stage.

    ``measured(sums, pixels)`` gives the standard errors of some pixels, 0 where that is certain and NaN where
    it is unknown.
    """
    found = Staged.empty((len(pixels), *b.shape[1:]))
    counts = np.full(len(pixels), min(_FIRST, most))
    stage = 0
    while counts.any():
        stream = _STREAMS[stage] if stage < len(_STREAMS) else stage
        following = np.zeros_like(counts)
        for count in np.unique(counts[counts > 0]):
            here = np.flatnonzero(counts == count)
            sums = walker.rows(b, pixels[here], 0, int(count), stream)
            standard = measured(sums, pixels[here])
            found.mean[here], found.standard_error[here] = sums.mean, standard
            found.samples[here] += count
            wanted, found.met[here] = _judged(sums, standard, error)
            over = _all(standard == 0.0) | (found.met[here] | (count >= most) if stage else False)
            following[here] = np.where(over, 0, _rounded_up(wanted, count if stage else 1, most))
        counts, stage = following, stage + 1
    return found


def _judged(sums: Sums, standard: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Samples that the next stage of each pixel needs, and whether this one met the error.

    The spread falls with the root of the samples, what they have not met as fast as they grow in number.
    """
    n, certain = sums.samples, standard == 0.0
    spread = np.where(np.isfinite(standard), np.minimum(sums.standard_error, standard), standard)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        share = np.nan_to_num((spread / standard) ** 2)  # of the variance, and so of what there is to doubt
        doubt = np.where(share > 0.0, np.minimum(sums.doubt, 1.0) * share, 0.0)
        met, unmet = n * (standard / error) ** 2 * np.stack([share, (1.0 - share) * n])
        needed = 0.5 * (met + np.sqrt(met**2 + 4.0 * unmet)) * (1.0 + 2.0 * doubt)
    believed = (doubt <= _DOUBT) & ~np.isnan(standard)
    more = np.where(believed, needed, np.fmax(needed, _GROWTH * n))
    more = np.where(certain, 0.0, more)
    return more.reshape(len(more), -1).max(axis=1), _all(certain | (believed & (standard <= error)))


def _rounded_up(wanted: np.ndarray, above: int, most: int) -> np.ndarray:
    """Powers of two, so that pixels of like need share a launch: more than `above`, at least the first."""
    powers = 2.0 ** np.ceil(np.log2(np.clip(wanted, max(_FIRST, above + 1), max(most, _FIRST))))
    return np.minimum(powers, most).astype(np.int64)


def _all(columns: np.ndarray) -> np.ndarray:
    return np.all(columns.reshape(len(columns), -1), axis=1)
