# SPDX-License-Identifier: BSD-3-Clause
"""The first bounce F of a measured T = S F (eq. 3), and what to do where it is dark.

F_i = 1 / (T^-1)_ii, since T^-1 = F^-1 (I - A) and A has no diagonal. Where T is too large to
invert, T^-1 = F0^-1 S0^-1 with F0 = diag(T), S0 = T F0^-1, and z_i (S0^-1 z)_i of random signs z
has the mean (S0^-1)_ii and, of K probes, the variance sum_{j != i} (S0^-1)_ij^2 / K (Bekas,
Kokiopoulou, Saad 2007).
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import interreflections
from ltcl.solvers import solve

logger = logging.getLogger(__name__)
_BYTES = 3 * 8  # of a dense inverse, per entry: the matrix, its inverse and what LAPACK works with
_RTOL = (
    1e-5  # of the solves of an estimate: far below the scatter of any affordable number of probes
)
_TOGETHER = 32  # probes in one solve
ENTRIES = np.ndarray, scipy.sparse.csr_array
_SIGMAS = 5.0  # standard deviations that noise does not exceed, even in a million pixels
# of the median: 20 stops below it, beyond any camera; float32 has 3 bits left of such light
DARK = 1e-6
_FAINT = 0.05  # times the median first bounce: noise is estimated only where some pixel is below


def find(
    matrices: Sequence[Any],
    requested: Any,
    device: Any,
    probes: int = 128,
    seed: int = 0,
    dark: Any = None,
) -> tuple[np.ndarray, np.ndarray | None]:
    """F (channels, N) float64 of any sign, diag(T) where that is `dark`; standard error of an estimate."""
    n: int = matrices[0].shape[0]
    checks.count("probes", probes, least=2)
    checks.count("seed", seed, least=0)
    if not isinstance(requested, str):
        F = checks.finite("first_bounce", checks.real("first_bounce", requested)).astype(np.float64)
        F = checks.shape("first_bounce", F, (n,), (len(matrices), n))
        return np.broadcast_to(F, (len(matrices), n)), None
    checks.one_of("first_bounce", requested, ("diagonal", "exact", "estimate"))
    if requested == "exact" and (
        bare := [type(T).__name__ for T in matrices if not isinstance(T, ENTRIES)]
    ):
        raise InputTypeError(
            f"first_bounce is 'exact', but a {bare[0]} has no entries; give 'estimate' or F"
        )
    F = np.stack([_diagonal(T) for T in matrices])
    if requested == "diagonal":
        if (brightest := float(np.max(F))) > float(np.finfo(np.float32).max):
            raise InputError(
                f"matrix reaches {brightest:.3g}, beyond float32; give it in other units"
            )
        return F, None
    lit = np.ones(F.shape, bool) if dark is None else ~dark(F)
    if requested == "exact":
        try:
            checks.fits_host(f"a dense inverse of {n} pixels", _BYTES * n**2)
            return np.where(
                lit, [_exact(*each) for each in zip(matrices, lit, strict=True)], F
            ), None
        except MemoryError:
            logger.warning("T of %d pixels is too large for a dense inverse; F is estimated", n)
    estimate, error = _estimate(
        matrices, np.where(lit, np.maximum(F, 0.0), 0.0), device(), probes, seed
    )
    return np.where(lit, estimate, F), error


def _diagonal(matrix: Any) -> np.ndarray:
    if not hasattr(matrix, "diagonal"):
        kind = type(matrix).__name__
        raise InputError(
            f"first_bounce is 'diagonal', but a {kind} has no diagonal(); give an array (N,)"
        )
    return np.asarray(matrix.diagonal(), np.float64)


def _exact(matrix: Any, lit: np.ndarray) -> np.ndarray:
    """1 / diag(T^-1), by a dense inverse of the pixels that are lit."""
    dense = (matrix if isinstance(matrix, np.ndarray) else matrix.toarray()).astype(np.float64)
    lit = lit & dense.any(axis=0) & dense.any(axis=1)  # a dark pixel would make T singular
    dense = dense[np.ix_(lit, lit)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", scipy.linalg.LinAlgWarning)  # no digit would be right
            inverse = scipy.linalg.inv(dense, overwrite_a=True, check_finite=False)
    except RuntimeError as error:  # SciPy's of work arrays that LAPACK did not get
        raise MemoryError(str(error)) from error
    except (np.linalg.LinAlgError, scipy.linalg.LinAlgWarning) as error:
        raise InputError(
            "first_bounce is 'exact', but T is singular in float64; give 'diagonal'"
        ) from error
    F = np.zeros(lit.shape)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        F[lit] = 1.0 / np.diagonal(inverse)
    return np.nan_to_num(F, nan=0.0, posinf=0.0, neginf=0.0)


def _estimate(
    matrices: Sequence[Any], F0: np.ndarray, device: Device, probes: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """F and its standard error, (channels, N) float64 each; F is 0 where `F0` is."""
    F, error = np.zeros_like(F0), np.zeros_like(F0)
    signs = np.random.default_rng(seed).choice(np.array([-1, 1], np.float32), (F0.shape[1], probes))
    together = np.split(signs, range(_TOGETHER, probes, _TOGETHER), axis=1)
    for channel, S in enumerate(interreflections(matrices, F0, device)):
        try:
            solutions = [solve(S.as_it_stands(), z, "chebyshev", rtol=_RTOL) for z in together]
        except ConvergenceError as failed:
            raise InputError(
                f"first_bounce is 'estimate', whose solves end at a residual {failed.solution.residual:.2g}: "
                "T is far from that of a diffuse scene; give 'diagonal' or an array (N,)"
            ) from failed
        samples = signs * np.hstack([s.x for s in solutions])  # z_i (S^-1 z)_i, (N, probes)
        mean, left = samples.mean(axis=1, dtype=np.float64), max(s.residual for s in solutions)
        spread = np.hypot(samples.std(axis=1, ddof=1, dtype=np.float64) / np.sqrt(probes), left)
        np.divide(F0[channel], mean, out=F[channel], where=mean > 0)
        np.divide(F[channel] * spread, mean, out=error[channel], where=mean > 0)
    return F, error


def dark(
    matrices: Sequence[Any], share: float, noise: Any, known: bool, F: np.ndarray
) -> np.ndarray:
    """Where F (channels, N) or diag(T) is not above 0, `share` of the median, and `noise()`.

    What is not `known` but estimated counts up to the scatter of the pixel's column: dim light is
    not dark.
    """
    light, sigma = F, 0.0
    if entries := all(isinstance(T, ENTRIES) for T in matrices):
        light = np.minimum(F, [_diagonal(T) for T in matrices])
    median = np.array([[np.median(f[f > 0]) if np.any(f > 0) else 0.0] for f in light])
    least = np.maximum(1e-300, share * median)  # 0 is dark as well, whose inverse is no number
    below = _SIGMAS * np.maximum(
        -light.min(axis=1, keepdims=True), 0.0
    )  # light is never negative, noise is
    faint = (light > least) & (light < np.maximum(_FAINT * median, below))
    if known or (entries and faint.any()):
        sigma = noise().diagonal(light)
        for T, own, j in zip(matrices, sigma, faint, strict=True) if not known else ():
            column = abs(T[:, j])
            scatter = (
                1.25
                * column.sum(axis=0, dtype=np.float64)
                / np.maximum((column != 0).sum(axis=0), 1)
            )
            own[:], own[j] = (
                0.0,
                np.minimum(own[j], scatter),
            )  # 1.25 times the mean, as of normal noise
    return light <= np.maximum(least, _SIGMAS * sigma)


def mask_dark(
    F: np.ndarray, dark: np.ndarray, grid: tuple[int, int], may_mask: bool
) -> tuple[Any, Any, str]:
    """F with 0 and True (N,) where it is `dark` in some channel, and why; refused unless it may be masked."""
    dark = np.logical_or.reduce(dark, axis=0)
    pixels, zero = np.flatnonzero(dark), np.count_nonzero(dark & np.any(F <= 0.0, axis=0))
    if dark.all():
        raise InputError(
            "first_bounce is zero or negative at every pixel, or noise: check black level of T"
        )
    why = f"zero or negative at {zero}, within its noise or below dark at {len(pixels) - zero}"
    why = f"first_bounce is dark at {len(pixels)} of {len(dark)} pixels ({why})"
    if not len(pixels) or may_mask:
        return np.where(dark, 0.0, F), dark, why
    first = ", ".join(f"({pixel // grid[1]}, {pixel % grid[1]})" for pixel in pixels[:8])
    advice = "give on_dark='mask' to leave them unlit, which a LinearOperator cannot"
    raise InputError(f"{why} at (row, column): {first}; {advice}")


def certain(F: np.ndarray, variance: np.ndarray, sigmas: float) -> np.ndarray:
    """`F` where it is so many standard deviations above 0, else 0: with noise for F, S would be anything."""
    return np.where(sigmas * np.sqrt(variance) < F, F, 0.0)
