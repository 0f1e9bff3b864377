# SPDX-License-Identifier: BSD-3-Clause
"""The first bounce F of a measured T = S F (eq. 3), and projector pixels where it is dark.

    F_i = 1 / (T^-1)_ii

since T^-1 = F^-1 (I - A) and A has no diagonal. A T that is too large to invert is scaled by
F0 = diag(T): T^-1 = F0^-1 S0^-1 with S0 = T F0^-1. For random signs z, z_i (S0^-1 z)_i has the mean
(S0^-1)_ii and, over K probes, the variance sum_{j != i} (S0^-1)_ij^2 / K (Bekas, Kokiopoulou, Saad
2007).
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import IdentityPlus, interreflections
from ltcl.solvers import solve
from ltcl.transport.noise import Noise

logger = logging.getLogger(__name__)
# Types of matrices whose entries are read.
ENTRIES = np.ndarray, scipy.sparse.csr_array
# Times the median first bounce: 20 stops below it, beyond any camera; float32 resolves such light
# to 3 bits.
DARK_THRESHOLD = 1e-6
# Times the median first bounce: noise is estimated only if some pixel is below.
FAINT_SHARE = 0.05
# Standard deviations that noise does not exceed, even in a million pixels.
NOISE_SIGMAS = 5.0
# The inverse of a smaller first bounce is not a number.
MIN_FIRST_BOUNCE = 1e-300
# Mean of |x| to the standard deviation of normal x.
STD_PER_MEAN_ABSOLUTE = 1.25

# Bytes of a dense inverse for each entry: the matrix, its inverse and the work space of LAPACK.
INVERSE_BYTES_PER_ENTRY = 3 * 8
# Solves of an estimate: far below the scatter of any affordable number of probes.
ESTIMATE_RTOL = 1e-5
PROBES_PER_SOLVE = 32


def find_first_bounce(
    matrices: Sequence[Any],
    requested: Any,
    device: Callable[[], Device],
    probes: int = 128,
    seed: int = 0,
    rule: DarkRule | None = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """F (channels, N) float64, and the standard error of an estimate.

    F has any sign, and is diag(T) at the pixels that `rule` finds dark.
    """
    checks.count("probes", probes, least=2)
    checks.count("seed", seed, least=0)
    if not isinstance(requested, str):
        return _check_first_bounce(matrices, requested), None
    checks.one_of("first_bounce", requested, ("diagonal", "exact", "estimate"))
    if requested == "exact":
        _require_entries(matrices)
    F = np.stack([_diagonal(T) for T in matrices])
    if requested == "diagonal":
        _refuse_beyond_float32(F)
        return F, None
    is_lit = np.ones(F.shape, bool)
    if rule is not None:
        is_lit = ~rule.find_dark(F)
    if requested == "exact":
        n = F.shape[1]
        needed = INVERSE_BYTES_PER_ENTRY * n**2
        try:
            checks.fits_host(f"a dense inverse of {n} pixels", needed)
            exact = list(map(_exact, matrices, is_lit))
            return np.where(is_lit, exact, F), None
        except MemoryError:
            logger.warning("T of %d pixels is too large for a dense inverse; F is estimated", n)
    F0 = np.where(is_lit, np.maximum(F, 0.0), 0.0)
    estimate, error = _estimate(matrices, F0, device(), probes, seed)
    return np.where(is_lit, estimate, F), error


def _check_first_bounce(matrices: Sequence[Any], F: Any) -> np.ndarray:
    """A given first bounce, (N,) or (channels, N), as (channels, N) float64."""
    n: int = matrices[0].shape[0]
    channels = len(matrices)
    F = checks.real("first_bounce", F)
    F = checks.finite("first_bounce", F).astype(np.float64)
    F = checks.shape("first_bounce", F, (n,), (channels, n))
    return np.broadcast_to(F, (channels, n))


def _require_entries(matrices: Sequence[Any]) -> None:
    for T in matrices:
        if not isinstance(T, ENTRIES):
            kind = type(T).__name__
            raise InputTypeError(
                f"first_bounce is 'exact', but a {kind} has no entries; give 'estimate' or F"
            )


def _refuse_beyond_float32(F: np.ndarray) -> None:
    brightest = float(np.max(F))
    if brightest > float(np.finfo(np.float32).max):
        raise InputError(f"matrix reaches {brightest:.3g}, beyond float32; give it in other units")


def _diagonal(matrix: Any) -> np.ndarray:
    if not hasattr(matrix, "diagonal"):
        kind = type(matrix).__name__
        raise InputError(
            f"first_bounce is 'diagonal', but a {kind} has no diagonal(); give an array (N,)"
        )
    return np.asarray(matrix.diagonal(), np.float64)


def _exact(matrix: Any, is_lit: np.ndarray) -> np.ndarray:
    """1 / diag(T^-1), by a dense inverse of the pixels that are lit."""
    dense = matrix
    if not isinstance(matrix, np.ndarray):
        dense = matrix.toarray()
    dense = dense.astype(np.float64)
    # A dark pixel would make T singular.
    is_lit = is_lit & dense.any(axis=0) & dense.any(axis=1)
    dense = dense[np.ix_(is_lit, is_lit)]
    try:
        with warnings.catch_warnings():
            # No digit of such an inverse would be right.
            warnings.simplefilter("error", scipy.linalg.LinAlgWarning)
            inverse = scipy.linalg.inv(dense, overwrite_a=True, check_finite=False)
    except RuntimeError as error:
        # SciPy raises it for work arrays that LAPACK did not get.
        raise MemoryError(str(error)) from error
    except (np.linalg.LinAlgError, scipy.linalg.LinAlgWarning) as error:
        raise InputError(
            "first_bounce is 'exact', but T is singular in float64; give 'diagonal'"
        ) from error
    F = np.zeros(is_lit.shape)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        F[is_lit] = 1.0 / np.diagonal(inverse)
    return np.nan_to_num(F, nan=0.0, posinf=0.0, neginf=0.0)


def _estimate(
    matrices: Sequence[Any], F0: np.ndarray, device: Device, probes: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """F and its standard error, (channels, N) float64 each; F is 0 where `F0` is 0."""
    random = np.random.default_rng(seed)
    signs = random.choice(np.array([-1, 1], np.float32), (F0.shape[1], probes))
    F = np.zeros_like(F0)
    error = np.zeros_like(F0)
    for channel, S0 in enumerate(interreflections(matrices, F0, device)):
        mean, spread = _probe_inverse_diagonal(S0, signs)
        is_known = mean > 0
        estimate = F[channel]
        np.divide(F0[channel], mean, out=estimate, where=is_known)
        np.divide(estimate * spread, mean, out=error[channel], where=is_known)
    return F, error


def _probe_inverse_diagonal(S0: IdentityPlus, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """diag(S0^-1) by random `signs` (N, probes), and its standard error, (N,) each."""
    probes = signs.shape[1]
    groups = np.split(signs, range(PROBES_PER_SOLVE, probes, PROBES_PER_SOLVE), axis=1)
    operator = S0.as_it_stands()
    try:
        solutions = [solve(operator, z, "chebyshev", rtol=ESTIMATE_RTOL) for z in groups]
    except ConvergenceError as failed:
        raise InputError(
            "first_bounce is 'estimate', whose solves end at a residual "
            f"{failed.solution.residual:.2g}: T is far from that of a diffuse scene; "
            "give 'diagonal' or an array (N,)"
        ) from failed
    # z_i (S0^-1 z)_i
    samples = signs * np.hstack([solution.x for solution in solutions])
    residual = max(solution.residual for solution in solutions)
    mean = samples.mean(axis=1, dtype=np.float64)
    scatter = samples.std(axis=1, ddof=1, dtype=np.float64) / np.sqrt(probes)
    return mean, np.hypot(scatter, residual)


@dataclass(frozen=True, kw_only=True)
class DarkRule:
    """Rule for projector pixels without direct light.

    A pixel is dark if its first bounce or its entry of diag(T) is not above all of: 0, `threshold`
    times the median one, and 5 standard deviations of its noise.

    Attributes
    ----------
    matrices : sequence of (N, N)
        T of each channel.
    threshold : float
        Share of the median first bounce.
    noise : callable
        Returns the noise of T; called only if it is needed, as it may have to be estimated.
    is_measured : bool
        Whether that noise was measured. Estimated noise counts up to the scatter of the pixel's
        column, so that dim light is not dark.
    """

    matrices: Sequence[Any]
    threshold: float
    noise: Callable[[], Noise]
    is_measured: bool

    def find_dark(self, F: np.ndarray) -> np.ndarray:
        """Dark pixels of F (channels, N) of any sign, bool of the same shape."""
        light = F
        has_entries = all(isinstance(T, ENTRIES) for T in self.matrices)
        if has_entries:
            light = np.minimum(F, [_diagonal(T) for T in self.matrices])
        median = _median_of_lit(light)
        least = np.maximum(MIN_FIRST_BOUNCE, self.threshold * median)
        # Light is never negative, noise is.
        most_negative = np.maximum(-light.min(axis=1, keepdims=True), 0.0)
        faint_limit = FAINT_SHARE * median
        faint_limit = np.maximum(faint_limit, NOISE_SIGMAS * most_negative)
        is_faint = (light > least) & (light < faint_limit)
        if self.is_measured:
            sigma = self.noise().diagonal(light)
            least = np.maximum(least, NOISE_SIGMAS * sigma)
        elif has_entries and is_faint.any():
            sigma = self._estimated_sigma(light, is_faint)
            least = np.maximum(least, NOISE_SIGMAS * sigma)
        return light <= least

    def _estimated_sigma(self, light: np.ndarray, is_faint: np.ndarray) -> np.ndarray:
        """Standard deviation (channels, N) by estimated noise; 0 at pixels that are not faint."""
        sigma = self.noise().diagonal(light)
        for T, channel_sigma, pixels in zip(self.matrices, sigma, is_faint, strict=True):
            column = abs(T[:, pixels])
            nonzeros = np.maximum((column != 0).sum(axis=0), 1)
            scatter = STD_PER_MEAN_ABSOLUTE * column.sum(axis=0, dtype=np.float64) / nonzeros
            faint_sigma = np.minimum(channel_sigma[pixels], scatter)
            channel_sigma[:] = 0.0
            channel_sigma[pixels] = faint_sigma
        return sigma


def _median_of_lit(light: np.ndarray) -> np.ndarray:
    """Median (channels, 1) of the values above 0; 0 if there are none."""
    medians = np.zeros((len(light), 1))
    for channel, values in enumerate(light):
        if np.any(values > 0):
            medians[channel] = np.median(values[values > 0])
    return medians


def mask_dark(
    F: np.ndarray, is_dark: np.ndarray, grid: tuple[int, int], may_mask: bool
) -> tuple[np.ndarray, np.ndarray, str]:
    """Leave out the pixels that are dark in some channel, or refuse them unless they may be masked.

    Returns F (channels, N) with 0 at these pixels, the pixels (N,) bool, and the reason in words.
    """
    is_masked = np.logical_or.reduce(is_dark, axis=0)
    if is_masked.all():
        raise InputError(
            "first_bounce is zero or negative at every pixel, or noise: check black level of T"
        )
    pixels = np.flatnonzero(is_masked)
    zero = np.count_nonzero(is_masked & np.any(F <= 0.0, axis=0))
    dim = len(pixels) - zero
    reason = (
        f"first_bounce is dark at {len(pixels)} of {len(is_masked)} pixels "
        f"(zero or negative at {zero}, "
        f"within its noise or below the dark threshold at {dim})"
    )
    if may_mask or len(pixels) == 0:
        return np.where(is_masked, 0.0, F), is_masked, reason
    places = [divmod(int(pixel), grid[1]) for pixel in pixels[:8]]
    first = ", ".join(map(str, places))
    advice = "give on_dark='mask' to leave them unlit, which a LinearOperator cannot"
    raise InputError(f"{reason} at (row, column): {first}; {advice}")


def drop_uncertain(F: np.ndarray, variance: np.ndarray, sigmas: float) -> np.ndarray:
    """`F` with 0 where it is not `sigmas` standard deviations above 0.

    A first bounce that is noise would make S arbitrary.
    """
    return np.where(sigmas * np.sqrt(variance) < F, F, 0.0)
