# SPDX-License-Identifier: BSD-3-Clause
"""The first bounce F of a measured T = S F (eq. 3), and what to do where it is dark.

F_i = 1 / (T^-1)_ii, since T^-1 = F^-1 (I - A) and A has no diagonal. Where T is too large to invert, with
F0 = diag(T) as preconditioner, T^-1 = F0^-1 S0^-1, S0 = T F0^-1. For a random vector z of signs +-1 the
product z_i (S0^-1 z)_i has the mean (S0^-1)_ii; averaged over K probes its variance is that of the rest of
the row, sum_{j != i} (S0^-1)_ij^2 / K (Bekas, Kokiopoulou, Saad, An estimator for the diagonal of a matrix,
Applied Numerical Mathematics 57, 2007, after Hutchinson). That rest is one bounce spread over many pixels,
so few probes are enough; 32 of them are solved together.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.operators import Operator, interreflections
from ltcl.solvers import solve

_BYTES = 3 * 8  # of a dense inverse, per entry: the matrix, its inverse and what LAPACK works with
_RTOL = 1e-5  # of the solves of an estimate: far below the scatter of any affordable number of probes
_TOGETHER = 32  # probes in one solve


def find(matrices: Sequence[Any], first_bounce: Any) -> np.ndarray:
    """F of each channel, (channels, N) float64, not yet checked for sign; not "estimate"."""
    n: int = matrices[0].shape[0]
    if isinstance(first_bounce, str):
        checks.one_of("first_bounce", first_bounce, ("diagonal", "exact", "estimate"))
        return np.stack([_diagonal(T) if first_bounce == "diagonal" else _exact(T) for T in matrices])
    F = checks.finite("first_bounce", checks.real("first_bounce", first_bounce)).astype(np.float64)
    checks.shape("first_bounce", F, *([(n,), (1, n)] if len(matrices) == 1 else [(n,), (3, n)]))
    return np.broadcast_to(F, (len(matrices), n))


def too_large(matrix: Any) -> bool:
    """Whether "exact" would invert more than the host has memory for."""
    return _BYTES * matrix.shape[0] ** 2 > checks.host_memory()


def _diagonal(matrix: Any) -> np.ndarray:
    if callable(getattr(matrix, "diagonal", None)):
        return np.asarray(matrix.diagonal(), np.float64)
    raise InputError(
        f"first_bounce is 'diagonal', but a {type(matrix).__name__} has no diagonal(); "
        "give first_bounce as an array (N,)"
    )


def _exact(matrix: Any) -> np.ndarray:
    """1 / diag(T^-1), by a dense inverse of the pixels that are lit."""
    n = matrix.shape[1]
    if not isinstance(matrix, (np.ndarray, scipy.sparse.csr_array)):
        raise InputTypeError(
            f"first_bounce='exact' inverts the matrix densely, which a {type(matrix).__name__} does not "
            "allow; give 'estimate', or first_bounce as an array (N,)"
        )
    checks.fits_host(f"first_bounce='exact' inverts T densely, which for N = {n}", _BYTES * n * n)
    dense = (matrix if isinstance(matrix, np.ndarray) else matrix.toarray()).astype(np.float64)
    lit = dense.any(axis=0) & dense.any(axis=1)  # a dark pixel would make T singular; its F is 0
    if not lit.all():
        dense = dense[np.ix_(lit, lit)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", scipy.linalg.LinAlgWarning)  # no digit would be right
            inverse = scipy.linalg.inv(dense, overwrite_a=True, check_finite=False)
    except (np.linalg.LinAlgError, scipy.linalg.LinAlgWarning) as error:
        raise InputError(
            "first_bounce is 'exact', which needs an invertible T, but this one is singular in float64; "
            "give 'diagonal' or an array (N,)"
        ) from error
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        inverted = 1.0 / np.diagonal(inverse)
    F = np.zeros(n)
    F[lit] = np.where(np.isfinite(inverted), inverted, 0.0)
    return F


def estimate(
    matrices: Sequence[Any], device: Device, probes: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """F and its standard error, (channels, N) float64 each; F is 0 where diag(T) is not positive.

    Raises
    ------
    InputError
        A matrix without a diagonal, or whose S0 Chebyshev's iteration cannot invert.

    Examples
    --------
    >>> import ltcl
    >>> T = np.array([[0.5, 0.1], [0.1, 0.5]])
    >>> F, error = estimate([T], ltcl.open_device(), probes=400, seed=0)
    >>> bool(np.all(abs(F - 0.48) < 4 * error)), bool(np.all(error < 0.01))
    (True, True)
    """
    F0 = np.maximum(find(matrices, "diagonal"), 0.0)
    F, error = np.zeros_like(F0), np.zeros_like(F0)
    for channel, S in enumerate(interreflections(matrices, F0, device)):
        mean, spread = _diagonal_of_inverse(S.as_it_stands(), probes, seed)
        np.divide(F0[channel], mean, out=F[channel], where=mean > 0)
        np.divide(F[channel] * spread, mean, out=error[channel], where=mean > 0)
    return F, error


def _diagonal_of_inverse(S: Operator, probes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """diag(S^-1) and its standard error, (N,) each; what the solves left is part of the error."""
    n, rng = S.shape[0], np.random.default_rng(seed)
    total, squares, worst = np.zeros(n), np.zeros(n), 0.0
    for start in range(0, probes, _TOGETHER):
        signs = rng.integers(0, 2, (n, min(_TOGETHER, probes - start))).astype(np.float32) * 2 - 1
        try:
            solution = solve(S, signs, "chebyshev", rtol=_RTOL)
        except ConvergenceError as error:
            raise InputError(
                f"first_bounce is 'estimate', whose solves ended at a relative residual of "
                f"{error.solution.residual:.2g}; T is far from that of a diffuse scene; give 'diagonal' or "
                "an array (N,)"
            ) from error
        samples = signs * solution.x.astype(np.float64)
        total += samples.sum(axis=1)
        squares += (samples**2).sum(axis=1)
        worst = max(worst, solution.residual)
    mean = total / probes
    variance = np.maximum(squares - probes * mean**2, 0.0) / (probes - 1)
    return mean, np.hypot(np.sqrt(variance / probes), worst)


def refuse_dark(dark: np.ndarray, grid: tuple[int, int], on_dark: str, maskable: bool) -> None:
    """Refuse pixels without a positive first bounce, unless they may be masked and this T is `maskable`."""
    pixels = np.flatnonzero(dark.any(axis=0))
    if len(pixels) == dark.shape[1]:
        raise InputError(
            "first_bounce is zero or negative at every pixel; it must be positive where light falls: "
            "check the sign and the black level of T"
        )
    if on_dark == "mask" and maskable:
        return
    listed = ", ".join(f"({pixel // grid[1]}, {pixel % grid[1]})" for pixel in pixels[:8])
    more = f" and {len(pixels) - 8} more" if len(pixels) > 8 else ""
    advice = "give on_dark='mask' to leave these pixels unlit"
    if on_dark == "mask":
        advice = "a LinearOperator cannot be masked here, mask it yourself"
    raise InputError(
        f"first_bounce is zero or negative at {len(pixels)} of {dark.shape[1]} pixels (row, column): "
        f"{listed}{more}; it must be positive; {advice}"
    )


def certain(F: np.ndarray, variance: np.ndarray, sigmas: float) -> np.ndarray:
    """`F` where it is above 0 by so many standard deviations, else 0: a pixel to be masked.

    With noise for F, S = T F^-1 would be anything. What has a variance of NaN is not certain.

    >>> certain(np.array([4.0, 2.0, -4.0, 4.0]), np.array([1.0, 1.0, 1.0, np.nan]), 3.0).tolist()
    [4.0, 0.0, 0.0, 0.0]
    """
    return np.where(sigmas * np.sqrt(variance) < F, F, 0.0)
