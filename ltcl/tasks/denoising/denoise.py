# SPDX-License-Identifier: BSD-3-Clause
"""`denoise`: a measured T with less noise, channel by channel; the steps stand in this package."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator
from ltcl.tasks.denoising.multiwavelets import Grid
from ltcl.tasks.denoising.problem import DenoisingProblem
from ltcl.tasks.denoising.risk import (
    NOISE_MARGIN,
    NoiseProbe,
    has_structure,
    max_risk,
    noise_to_add,
    picture_risk,
    probe_count,
)
from ltcl.tasks.denoising.shrinkage import NoteShare, first_estimate, refine
from ltcl.tasks.requirements import check_progress
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

log = logging.getLogger(__name__)

# Arrays of float32 of the size of T that are in memory at once.
ARRAYS_AT_ONCE = 20


def denoise(T: Transport, *, progress: Callable[[str, float], object] | None = None) -> Transport:
    """T with less noise, by its noise model ``T.noise``.

    Parameters
    ----------
    T : Transport
        Entries (M, N) in 1 or 3 channels. Reciprocity is used only if T is square.
    progress : callable(text, share), optional

    Returns
    -------
    Transport
        T itself, with a warning, if its noise is unknown, if nothing shows that its pictures become
        better, or if what would be removed is not like noise. Else float32, on the same grid, with
        the same first bounce, mixing and masked pixels, without negative entries off the diagonal.
        Its `noise` is that of T, scaled to the estimated error of a picture under white; the first
        bounce itself has that of T, and errors of neighbours are alike.

    Raises
    ------
    InputTypeError
        A compressed T, or one of operators.
    InputError
        3 x 3 blocks between colours.
    MemoryLimitError
        The host lacks memory for 20 arrays of float32 of the size of T.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.transport.noise import Noise
    >>> exact = ltcl.scenes.dihedral(8, albedo=0.6).transport().to_numpy()
    >>> error = 0.001 * numpy.random.default_rng(0).standard_normal(exact.shape)
    >>> T = ltcl.Transport(exact + error, (8, 16), noise=Noise.uniform(exact.shape, 0.001))
    >>> bool(numpy.linalg.norm(ltcl.denoise(T).to_numpy() - exact) < 0.5 * numpy.linalg.norm(error))
    True
    """
    _check_entries(T)
    report = check_progress(progress)
    if T.noise.source == "unknown":
        log.warning("T does not show its noise, and is not changed: give noise= (--noise)")
        report("denoising", 1.0)
        return T
    channels = []
    for channel in range(T.channels):
        note = partial(_report_share, report, channel, T.channels)
        channels.append(_denoise_channel(T, channel, note))
        note(1.0)
    unchanged_count = sum(channel.entries is None for channel in channels)
    if unchanged_count:
        log.warning(
            "%d of %d channels of T are not changed: nothing shows that pictures become better",
            unchanged_count,
            T.channels,
        )
    if unchanged_count == T.channels:
        return T
    matrices = []
    for matrix, channel in zip(T.matrices, channels, strict=True):
        entries = channel.entries
        if entries is None:
            entries = _dense(matrix)
        matrices.append(entries)
    shares = np.array([channel.variance_share for channel in channels])
    return _transport_like(T, matrices, _scaled_noise(T.noise, shares))


def _check_entries(T: Any) -> None:
    check_transport(T, square=False)
    if T.blocks is not None:
        raise InputError("T has blocks between colours; denoise takes a T of 1 or 3 channels")
    for A in T.matrices:
        has_entries = isinstance(A, np.ndarray) or hasattr(A, "tocsr")
        if isinstance(A, Operator) or not has_entries:
            raise InputTypeError(
                f"T is made of {type(A).__name__}; it must be of arrays or sparse: "
                "denoise, then compress"
            )
    rows, columns = T.shape
    checks.fits_host("denoising", 4 * ARRAYS_AT_ONCE * rows * columns)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DenoisedChannel:
    """Entries (M, N), None if they stay, and the share of the variance of noise that is left."""

    entries: np.ndarray | None = None
    variance_share: float = 1.0


def _denoise_channel(T: Transport, channel: int, note: NoteShare) -> DenoisedChannel:
    """The channel with less noise, or as it is if nothing shows that its pictures become better."""
    Y = _dense(T.matrices[channel])
    # In this unit, a power of 2, squares fit into float32.
    _, exponent = np.frexp(np.abs(Y).max(initial=0.0))
    unit = np.float32(2.0 ** int(exponent))
    Y /= unit
    noise = dataclasses.replace(
        T.noise,
        photons=T.noise.photons / unit,
        floor=T.noise.floor / unit,
    )
    trials = _Trials(Y, noise, channel, (T.camera_grid, T.grid), note)
    for may_be_reciprocal in (True, False):
        run = trials.run(Y, may_be_reciprocal)
        is_gain = trials.risk(run, may_be_reciprocal) <= max_risk(len(Y))
        if is_gain and not has_structure(Y - run.entries, trials.grids):
            entries = unit * run.entries
            return DenoisedChannel(entries=entries, variance_share=run.variance_share)
        if not run.is_reciprocal:
            break
    return DenoisedChannel()


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Run:
    """Denoised entries (M, N), and the share of the variance of noise that is left."""

    entries: np.ndarray
    variance_share: float
    is_reciprocal: bool


class _Trials:
    """Ways to denoise the measured entries Y, (M, N), of a channel, and their risks."""

    def __init__(
        self, Y: np.ndarray, noise: Noise, channel: int, grids: tuple[Grid, Grid], note: NoteShare
    ) -> None:
        self.Y = Y
        self.noise = noise
        self.channel = channel
        self.grids = grids
        self.camera_grid, self.grid = grids
        self.note = note
        self.runs = 0
        self.probe_count = probe_count(len(Y))

    def run(self, Y: np.ndarray, may_be_reciprocal: bool) -> _Run:
        """Denoise these entries, (M, N)."""
        problem = DenoisingProblem.from_entries(
            Y, self.noise, self.channel, self.camera_grid, self.grid, may_be_reciprocal
        )
        first = first_estimate(problem, lambda share: self._note(share / 2))
        problem = first.problem
        estimate = refine(problem, first.pilot, lambda share: self._note((1.0 + share) / 2))
        left = np.where(problem.is_outstanding, 0.0, estimate.noise / problem.gauge)
        entries = problem.restore_entries(estimate.Z, Y)
        variance = self.noise.variance(entries, self.channel).sum()
        self.runs += 1
        return _Run(
            entries=entries,
            variance_share=_variance_share(left, variance),
            is_reciprocal=problem.is_reciprocal,
        )

    def risk(self, run: _Run, may_be_reciprocal: bool) -> float:
        """`picture_risk` of the denoised entries, by further runs with more noise."""
        probes = []
        for seed in range(self.probe_count):
            variance = self._variance(run.entries)
            added = noise_to_add(variance, self.noise, self.grid, self.channel, seed)
            del variance
            noisier = self.run(self.Y + added, may_be_reciprocal)
            probes.append(NoiseProbe(added=added, change=noisier.entries - run.entries))
        variance = self._variance(run.entries)
        filtered = partial(self.noise.filtered, grid=self.grid, channel=self.channel)
        margin = 1.0 if self.noise.is_measured else NOISE_MARGIN
        return picture_risk(self.Y, run.entries, variance, probes, filtered, self.grid, margin)

    def _variance(self, entries: np.ndarray) -> np.ndarray:
        """The variance of entries, (M, N), that may change: the first bounce stays."""
        variance = self.noise.variance(entries, self.channel)
        if self.camera_grid == self.grid:
            np.fill_diagonal(variance, 0.0)
        return variance

    def _note(self, share: float) -> None:
        # With and without reciprocity, and once more for each probe.
        most = 2 * (1 + self.probe_count)
        self.note((self.runs + share) / most)


def _variance_share(left: np.ndarray, variance: float) -> float:
    """The variance of errors under white by the noise `left`, (M, N), over that before."""
    if variance == 0.0:
        return 0.0
    error_under_white = left.sum(axis=1, dtype=float)
    return float(error_under_white @ error_under_white / variance)


def _dense(matrix: Any) -> np.ndarray:
    """A copy of a matrix, an array or sparse, as an array of float32."""
    if not isinstance(matrix, np.ndarray):
        matrix = matrix.tocsr().toarray()
    return matrix.astype(np.float32)


def _scaled_noise(noise: Noise, variance_shares: np.ndarray) -> Noise:
    """A noise model with these shares, (channels,), of the variance."""
    return dataclasses.replace(
        noise,
        photons=noise.photons * variance_shares,
        floor=noise.floor * np.sqrt(variance_shares),
        neighbours=0.0,
    )


def _transport_like(T: Transport, matrices: list[np.ndarray], noise: Noise) -> Transport:
    """A transport of other entries and noise, else like T."""
    first_bounce = T.first_bounce if T.is_square else "diagonal"
    result = Transport(
        matrices,
        T.grid,
        first_bounce,
        T.camera_grid,
        device=T._requested_device,
        dark_threshold=0.0,
        mixing=T.mixing,
        noise=noise,
    )
    result.first_bounce_error = T.first_bounce_error
    return result


def _report_share(
    report: Callable[[str, float], object], channel: int, channels: int, share: float
) -> None:
    """Report progress: `share` is that of a channel."""
    report("denoising", (channel + share) / channels)
