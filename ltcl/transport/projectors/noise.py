# SPDX-License-Identifier: BSD-3-Clause
"""Noise of several projectors: that of each T_k, in all of them, and in S of the scene.

The scans are independent, so that pictures have the sum of the variances. T of all has a `Noise` as
any other, fitted to the variances of all entries; pictures are exact (`JoinedErrors`). With

    R = sum_k (T_k - F_k) Q_k,    S = I + R

neighbouring columns of R share entries of T_k. An entry of R gets, from e of T_k with variance v,

    sum_n v_in Q_nj (sum_j' Q_nj')

so that the errors of even light are right, and those of single pixels are stated too large. The
direct light F_k, found in T_k, counts as known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.transport.covariance import EntryErrors
from ltcl.transport.noise import Noise
from ltcl.transport.noise.fit import noise_step
from ltcl.transport.projectors.montage import Montage
from ltcl.transport.transport import Transport


def joined_noise(
    transports: Sequence[Transport], matrices: Sequence[Sequence[Any]], montage: Montage
) -> Noise | None:
    """The noise (M, N) of all projectors side by side; None if that of some was not measured.

    `matrices` are the entries of each projector's channels.
    """
    noises = measured_noises(transports)
    if noises is None:
        return None
    shape = (transports[0].shape[0], montage.pixels)
    samples = []
    for channel in range(transports[0].channels):
        of_channel = [own[channel] for own in matrices]
        samples.append(_joined_samples(noises, of_channel, channel, montage))
    white = np.sum([noise.white for noise in noises], axis=0)
    fitted = Noise.fit(shape, samples, "acquired", white)
    return replace(fitted, source=_source(noises))


def measured_noises(transports: Sequence[Transport]) -> list[Noise] | None:
    """The noise of each transport; None if that of some was not measured."""
    noises = []
    for T in transports:
        if T.measured_noise is None:
            return None
        noises.append(T.measured_noise)
    return noises


def _source(noises: Sequence[Noise]) -> str:
    sources = {noise.source for noise in noises}
    return sources.pop() if len(sources) == 1 else "given"


def _joined_samples(
    noises: Sequence[Noise], matrices: Sequence[Any], channel: int, montage: Montage
) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns, light and variances of entries that `Noise.fit` looks at."""
    rows = matrices[0].shape[0]
    step = noise_step((rows, montage.pixels))
    for noise, matrix, places in zip(noises, matrices, montage.places, strict=True):
        for first in range(step):
            i = np.arange(first, rows, step)
            own = np.flatnonzero(places % step == first)
            if not len(own):
                continue
            light = _dense(matrix[i])[:, own]
            row = np.repeat(i, len(own))
            column = np.tile(own, len(i))
            values = light.ravel().astype(np.float64)
            variance = noise.entry_variance(channel, row, column, values)
            yield row, places[column], values, variance


def _dense(matrix: Any) -> np.ndarray:
    return matrix.toarray() if scipy.sparse.issparse(matrix) else np.asarray(matrix)


def scene_noise(
    noises: Sequence[Noise],
    matrices: Sequence[Sequence[Any]],
    directs: Sequence[Sequence[scipy.sparse.csr_array]],
    sharing: Sequence[Sequence[scipy.sparse.csr_array]],
    scene: Sequence[Any],
) -> Noise:
    """The noise (M, M) of S from that of each projector.

    `matrices`, `directs` (M, N_k) and `sharing` (N_k, M) are T_k, F_k and Q_k of each projector's
    channels, `scene` is S of each channel.
    """
    M = scene[0].shape[0]
    samples = []
    for channel in range(len(scene)):
        variance = np.zeros((M, M))
        for number, noise in enumerate(noises):
            v = noise.variance(_dense(matrices[number][channel]), channel)
            v[directs[number][channel].nonzero()] = 0.0
            Q = sharing[number][channel]
            of_even_light = np.asarray(Q.sum(axis=1)).ravel()
            weights = scipy.sparse.diags_array(of_even_light) @ Q
            variance += (scipy.sparse.csr_array(weights.T) @ v.T).T
        samples.append(_square_samples(_dense(scene[channel]), variance))
    fitted = Noise.fit((M, M), samples, "acquired")
    return replace(fitted, source=_source(noises))


def _square_samples(light: np.ndarray, variance: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns, light and variances of the entries that `Noise.fit` looks at."""
    pixels = len(light)
    step = noise_step(light.shape)
    for first in range(step):
        chosen = np.arange(first, pixels, step)
        window = np.ix_(chosen, chosen)
        i = np.repeat(chosen, len(chosen))
        j = np.tile(chosen, len(chosen))
        yield i, j, light[window].ravel().astype(np.float64), variance[window].ravel()


class JoinedErrors(EntryErrors):
    """The errors of all projectors: those of each one's part of a pattern, which are independent.

    `members` are T_k, `places` their pixels among all, `mixings` their colours.
    """

    def __init__(
        self,
        T: Transport,
        noise: Noise,
        members: Sequence[EntryErrors],
        montage: Montage,
        mixings: Sequence[np.ndarray],
    ) -> None:
        super().__init__(T, noise)
        self._members = members
        self._montage = montage
        self._mixings = mixings

    def variance(self, channel: int, squares: np.ndarray) -> np.ndarray:
        """sum_j v_ij squares_j, (M, k), of squares (N, k), or (3 N, k) of blocks."""
        total: Any = 0.0
        for number, member in enumerate(self._members):
            drive = self._drive_of_projector(number, channel, squares, 2)
            total = total + member.variance(channel, drive)
        return total

    def covariance(
        self, channel: int, patterns: np.ndarray, with_diagonal: bool = False
    ) -> np.ndarray:
        """Covariances (M, k, n, n) of E a for n patterns a (N, k, n), or (3 N, k, n) of blocks."""
        total: Any = 0.0
        for number, member in enumerate(self._members):
            drive = self._drive_of_projector(number, channel, patterns, 1)
            total = total + member.covariance(channel, drive)
        return total

    def _drive_of_projector(
        self, number: int, channel: int, patterns: np.ndarray, power: int
    ) -> np.ndarray:
        """The light that a channel of one projector answers to, of that of all."""
        places = self._montage.places[number]
        if self.T.blocks is None:
            return patterns[places]
        colours = np.split(patterns, 3)
        shares = self._mixings[number][channel] ** power
        light = np.zeros_like(colours[0][places])
        for share, colour in zip(shares, colours, strict=True):
            light = light + share * colour[places]
        return light
