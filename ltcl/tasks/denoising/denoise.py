# SPDX-License-Identifier: BSD-3-Clause
"""`denoise`: a measured T with less noise, channel by channel; the steps stand in this package."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator
from ltcl.tasks.denoising.problem import DenoisingProblem
from ltcl.tasks.denoising.shrinkage import NoteShare, first_estimate, refine
from ltcl.tasks.requirements import check_progress
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

# Arrays of float32 of the size of T that are in memory at once.
ARRAYS_AT_ONCE = 15


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
        The host lacks memory for 15 arrays of float32 of the size of T.

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
    matrices = []
    variance_shares = np.ones(T.channels)
    for channel in range(T.channels):
        note = partial(_report_share, report, channel, T.channels)
        entries, variance_shares[channel] = _denoise_channel(T, channel, note)
        matrices.append(entries)
    return _transport_like(T, matrices, _scaled_noise(T.noise, variance_shares))


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


def _denoise_channel(T: Transport, channel: int, note: NoteShare) -> tuple[np.ndarray, float]:
    """Denoised entries (M, N), and the share of the variance of noise that they have left."""
    matrix = T.matrices[channel]
    if not isinstance(matrix, np.ndarray):
        matrix = matrix.tocsr().toarray()
    Y = matrix.astype(np.float32)
    # In this unit, a power of 2, squares fit into float32.
    _, exponent = np.frexp(np.abs(Y).max(initial=0.0))
    unit = np.float32(2.0 ** int(exponent))
    Y /= unit
    noise = dataclasses.replace(
        T.noise,
        photons=T.noise.photons / unit,
        floor=T.noise.floor / unit,
    )
    problem = DenoisingProblem.from_entries(Y, noise, channel, T.camera_grid, T.grid)
    pilot = first_estimate(problem, note)
    estimate = refine(problem, pilot, lambda share: note(1.0 + share))
    entries = problem.restore_entries(estimate.Z, Y)
    # Errors of a picture under white, before and after.
    error_under_white = (estimate.noise / problem.gauge).sum(axis=1, dtype=float)
    variance_before = noise.variance(entries, channel).sum()
    if variance_before == 0.0:
        variance_before = 1.0
    share = error_under_white @ error_under_white / variance_before
    return unit * entries, share


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
