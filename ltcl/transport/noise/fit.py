# SPDX-License-Identifier: BSD-3-Clause
"""Fit of the noise of one channel to samples of its variance.

    square of (i, j) ~ rows_i columns_j (photons max(light, 0) + floor^2)

Passes take turns: factors of rows and columns by mean ratios, then photons and floor^2 by a
nonnegative least squares fit of mean ratios in octaves of light. Exact samples are variances, whose
sums over rows and columns are kept. Others are squares of errors, which count up to 9 variances.
Rows and columns whose squares are all 0 have the factor 0, and say nothing of the rest.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import scipy  # its subpackage optimize is loaded at the first use

# Parts of the samples of a channel: rows, columns, light, and squares, (n,) each.
Samples = Iterable[Sequence[np.ndarray]]

PASSES = 6
# Reweighted least squares fits of a pass.
LIGHT_PASSES = 6
# Samples of a row, about.
SAMPLES_PER_ROW = 256
# Bins of light: bin 0 has light that the floor hides, the last one the first bounce.
LIGHT_BINS = 32
# Variances that a squared error counts at most, and the mean of normal ones so clipped.
MAX_VARIANCES = 9.0
CLIPPED_MEAN = 0.995
# First bounces from which on their variance has a factor of its own.
MIN_FIRST_BOUNCES = 64
# Least floor^2, relative to the mean square.
MIN_FLOOR = 1e-6
# Squares that count as 0, relative to the largest: products of such factors would underflow.
ZERO_SHARE = 1e-60


@dataclass(kw_only=True)
class EntrySamples:
    """Squares of errors, or variances, of entries (i, j) with their light."""

    i: np.ndarray
    j: np.ndarray
    light: np.ndarray
    square: np.ndarray

    @classmethod
    def from_parts(cls, parts: Samples, stride: int) -> Self:
        """The samples of all parts; of each row and column one entry in `stride`."""
        thinned = []
        for i, j, light, square in parts:
            is_used = (i - j) % stride == 0
            thinned.append((i[is_used], j[is_used], light[is_used], square[is_used]))
        i, j, light, square = map(np.concatenate, zip(*thinned, strict=True))
        return cls(i=i, j=j, light=light, square=square)

    def select(self, is_used: np.ndarray) -> EntrySamples:
        """The samples at True of a mask (n,)."""
        return EntrySamples(
            i=self.i[is_used],
            j=self.j[is_used],
            light=self.light[is_used],
            square=self.square[is_used],
        )


@dataclass(kw_only=True)
class ChannelNoise:
    """Noise of one channel, as `Noise` has it."""

    photons: float
    floor: float
    rows: np.ndarray
    columns: np.ndarray
    direct: float = 1.0
    neighbours: float = 0.0
    is_known: bool = True


def noise_step(shape: tuple[int, int]) -> int:
    """The step of entries of T (M, N) that count: row and column differ by a multiple of it."""
    return max(1, min(shape) // SAMPLES_PER_ROW)


def fit_channel(shape: tuple[int, int], parts: Samples, is_exact: bool) -> ChannelNoise:
    """The noise of a channel of T (M, N)."""
    samples = EntrySamples.from_parts(parts, noise_step(shape))
    is_direct = (samples.i == samples.j) & (shape[0] == shape[1])
    direct_samples = samples.select(is_direct)
    if not is_exact:
        samples = samples.select(~is_direct)
    fit = _Fit(shape, samples, is_exact)
    fit.run()
    return ChannelNoise(
        photons=fit.photons,
        floor=fit.floor2**0.5,
        rows=fit.rows,
        columns=fit.columns,
        direct=fit.direct_factor(direct_samples),
    )


class _Fit:
    """State of the fit: factors of rows and columns, photons and floor^2."""

    def __init__(self, shape: tuple[int, int], samples: EntrySamples, is_exact: bool) -> None:
        self.is_exact = is_exact
        zero = ZERO_SHARE * samples.square.max(initial=0.0)
        self.rows = _start_factors(shape[0], samples.i, samples.square > zero)
        self.columns = _start_factors(shape[1], samples.j, samples.square > zero)
        # Each row and column that is left has a square above 0.
        samples = samples.select(self._factors_of(samples) > 0.0)
        self.samples = samples
        self.photons = 0.0
        self.floor2 = 0.0
        if len(samples.square):
            self.floor2 = float(samples.square.mean())
        self.brightest = samples.light.max(initial=0.0)
        if self.brightest == 0.0:
            self.brightest = 1.0

    def run(self) -> None:
        if not self.floor2 > 0:
            return
        scale = 1.0
        for number in range(PASSES):
            model = self.variance_of_light(self.samples.light)
            expected = self._factors_of(self.samples) * model
            ratios = self._ratios(expected)
            # Sums of exact samples are kept, so that large variances count more.
            weights = expected if self.is_exact else np.ones(len(ratios))
            scale = float(weights @ ratios / weights.sum())
            self._update_factors(ratios, weights, scale)
            if number < PASSES - 1:
                self._update_light(ratios * model)
        self.photons *= scale
        self.floor2 *= scale

    def variance_of_light(self, light: np.ndarray) -> np.ndarray:
        """photons light + floor^2."""
        return self.photons * np.maximum(light, 0.0) + self.floor2

    def _factors_of(self, samples: EntrySamples) -> np.ndarray:
        return self.rows[samples.i] * self.columns[samples.j]

    def _ratios(self, expected: np.ndarray) -> np.ndarray:
        """Squares over their expected values."""
        ratios = self.samples.square / expected
        if self.is_exact:
            return ratios
        return np.minimum(ratios, MAX_VARIANCES) / CLIPPED_MEAN

    def _update_factors(self, ratios: np.ndarray, weights: np.ndarray, scale: float) -> None:
        """Multiply factors of rows and columns by mean ratios; their mean stays 1."""
        samples = self.samples
        for factor, index in ((self.rows, samples.i), (self.columns, samples.j)):
            total = np.bincount(index, weights, len(factor))
            weighted = np.bincount(index, weights * ratios, len(factor))
            is_empty = total == 0
            weighted[is_empty] = scale
            total[is_empty] = 1.0
            factor *= weighted / total
            factor /= factor.mean()

    def _light_bins(self) -> np.ndarray:
        """The bin of light of each sample: octaves below the brightest."""
        samples = self.samples
        octave = LIGHT_BINS - 2 + np.frexp(samples.light / self.brightest)[1]
        octave = np.clip(octave, 1, LIGHT_BINS - 2)
        # Of light that the floor hides only the mean is known.
        is_hidden = samples.light**2 < MAX_VARIANCES * self.floor2
        bins = np.where(is_hidden, 0, octave)
        if self.is_exact:
            bins[samples.i == samples.j] = LIGHT_BINS - 1
        return bins

    def _update_light(self, variances: np.ndarray) -> None:
        """Fit photons and floor^2 to mean `variances` in bins of light, by relative errors."""
        bins = self._light_bins()
        counts = np.bincount(bins, minlength=LIGHT_BINS)
        is_used = counts > 0
        count = counts[is_used].astype(float)
        mean = np.bincount(bins, variances, LIGHT_BINS)[is_used] / count
        light = np.bincount(bins, self.samples.light, LIGHT_BINS)[is_used] / count
        relative_light = np.maximum(light, 0.0) / self.brightest
        A = np.stack([relative_light, np.ones(len(count))], axis=1)
        root = np.sqrt(count)
        if self.is_exact:
            # All exact samples together say the same of the first bounce.
            root[-1] = np.sqrt(len(variances))
        least = MIN_FLOOR * mean.max()
        x = np.array([self.photons * self.brightest, self.floor2])
        for _ in range(LIGHT_PASSES):
            weight = root / np.maximum(A @ x, least)
            x = scipy.optimize.nnls(A * weight[:, None], mean * weight)[0]
        self.photons = x[0] / self.brightest
        self.floor2 = max(x[1], least)

    def direct_factor(self, direct: EntrySamples) -> float:
        """Factor of the variance of the first bounce; 1 with too few samples of it."""
        expected = self._factors_of(direct) * self.variance_of_light(direct.light)
        is_noisy = expected > 0.0
        expected = expected[is_noisy]
        if len(expected) < (1 if self.is_exact else MIN_FIRST_BOUNCES):
            return 1.0
        ratios = direct.square[is_noisy] / expected
        clipped = np.minimum(ratios, MAX_VARIANCES * ratios.mean())
        if not self.is_exact:
            return float(clipped.mean())
        return float(np.average(clipped, weights=expected))


def _start_factors(n: int, index: np.ndarray, is_noisy: np.ndarray) -> np.ndarray:
    """Factors of n rows or columns to begin with: 0 where all samples are without noise, else 1."""
    samples = np.bincount(index, minlength=n)
    noisy_samples = np.bincount(index, is_noisy, n)
    return np.where((samples > 0) & (noisy_samples == 0), 0.0, 1.0)
