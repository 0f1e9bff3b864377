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
from ltcl.tasks.denoising.problem import DenoisingProblem
from ltcl.tasks.denoising.risk import picture_risk
from ltcl.tasks.denoising.shrinkage import NoteShare, first_estimate, refine
from ltcl.tasks.requirements import check_progress
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

log = logging.getLogger(__name__)

# Estimated squared error of pictures over that of T, at most, with room for the estimate's own.
MAX_RISK = 1.05
# Arrays of float32 of the size of T that are in memory at once.
ARRAYS_AT_ONCE = 18


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
        T itself, with a warning, if its noise is unknown or its pictures would become worse. Else
        float32, on the same grid, with the same first bounce, mixing and masked pixels, without
        negative entries off the diagonal. Its `noise` is that of T, scaled to the estimated error
        of a picture under white; the first bounce itself has that of T, and errors of neighbours
        are alike.

    Raises
    ------
    InputTypeError
        A compressed T, or one of operators.
    InputError
        3 x 3 blocks between colours.
    MemoryLimitError
        The host lacks memory for 18 arrays of float32 of the size of T.

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
    kept = sum(channel.risk > MAX_RISK for channel in channels)
    if kept:
        log.warning(
            "%d of %d channels of T are not changed: they would lose more light than noise",
            kept,
            T.channels,
        )
    if kept == T.channels:
        return T
    matrices = [channel.entries for channel in channels]
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
    """Entries (M, N), the share of the variance of noise that is left, and the risk of pictures."""

    entries: np.ndarray
    variance_share: float
    risk: float


def _denoise_channel(T: Transport, channel: int, note: NoteShare) -> DenoisedChannel:
    """The channel with less noise, or as it is if its pictures would become worse."""
    matrix = T.matrices[channel]
    if not isinstance(matrix, np.ndarray):
        matrix = matrix.tocsr().toarray()
    Y = matrix.astype(np.float32)
    unchanged = DenoisedChannel(entries=Y.copy(), variance_share=1.0, risk=np.inf)
    # In this unit, a power of 2, squares fit into float32.
    _, exponent = np.frexp(np.abs(Y).max(initial=0.0))
    unit = np.float32(2.0 ** int(exponent))
    Y /= unit
    noise = dataclasses.replace(
        T.noise,
        photons=T.noise.photons / unit,
        floor=T.noise.floor / unit,
    )
    for may_be_reciprocal in (True, False):
        problem = DenoisingProblem.from_entries(
            Y, noise, channel, T.camera_grid, T.grid, may_be_reciprocal
        )
        denoised = _solve(problem, Y, note)
        if denoised.risk <= MAX_RISK:
            return dataclasses.replace(denoised, entries=unit * denoised.entries)
        if not problem.is_reciprocal:
            break
    return unchanged


def _solve(problem: DenoisingProblem, Y: np.ndarray, note: NoteShare) -> DenoisedChannel:
    """Denoised entries of a problem with the measured entries Y, (M, N)."""
    first = first_estimate(problem, note)
    problem = first.problem
    estimate = refine(problem, first.pilot, lambda share: note(1.0 + share))
    entries = problem.restore_entries(estimate.Z, Y)
    left = np.where(problem.is_outstanding, 0.0, estimate.noise / problem.gauge)
    variance = problem.noise.variance(entries, problem.channel)
    # Errors of a picture under white, before and after.
    variance_before = variance.sum()
    if variance_before == 0.0:
        variance_before = 1.0
    error_under_white = left.sum(axis=1, dtype=float)
    share = error_under_white @ error_under_white / variance_before
    # The first bounce and outstanding entries stay, with their errors.
    variance[entries == Y] = 0.0
    risk = picture_risk(Y - entries, left, variance, problem)
    return DenoisedChannel(entries=entries, variance_share=share, risk=risk)


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
    """Report progress: `share` is 1 after the first estimate of a channel, and 2 at its end."""
    report("denoising", (channel + share / 2) / channels)
