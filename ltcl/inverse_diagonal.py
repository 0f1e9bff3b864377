# SPDX-License-Identifier: BSD-3-Clause
"""The first bounce F_i = 1 / (T^-1)_ii where T is too large to invert: a stochastic estimate with its error.

With F0 = diag(T) as preconditioner, T^-1 = F0^-1 S0^-1, S0 = T F0^-1. For a random vector z of signs +-1 the
product z_i (S0^-1 z)_i has the mean (S0^-1)_ii; averaged over K probes its variance is that of the rest of
the row, sum_{j != i} (S0^-1)_ij^2 / K (Bekas, Kokiopoulou, Saad, An estimator for the diagonal of a matrix,
Applied Numerical Mathematics 57, 2007, after Hutchinson). That rest is one bounce spread over many pixels,
so few probes are enough. All are solved together, by the Chebyshev iteration with the free bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl import first_bounces, theory
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError
from ltcl.operators import Operator, interreflections

_RTOL = 1e-5  # of the solves: far below the scatter of any affordable number of probes
_TOGETHER = 32  # probes in one solve


def estimate(
    matrices: Sequence[Any], device: Device, probes: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """F and its standard error, (channels, N) float64 each; F is 0 where diag(T) is not positive.

    Raises
    ------
    InputError
        A matrix that does not tell its diagonal, or whose S0 Chebyshev cannot invert.

    Examples
    --------
    >>> import ltcl
    >>> T = np.array([[0.5, 0.1], [0.1, 0.5]])
    >>> F, error = estimate([T], ltcl.open_device(), probes=400, seed=0)
    >>> bool(np.all(abs(F - 0.48) < 4 * error)), bool(np.all(error < 0.01))
    (True, True)
    """
    F0 = np.maximum(first_bounces.find(matrices, "diagonal"), 0.0)
    found = []
    for system, f in zip(interreflections(matrices, F0, device), F0, strict=True):
        mean, error = _diagonal_of_inverse(system, probes, seed)
        F = np.divide(f, mean, out=np.zeros_like(f), where=mean > 0)
        found.append((F, F * np.divide(error, mean, out=np.zeros_like(f), where=mean > 0)))
    F, error = (np.stack(parts) for parts in zip(*found, strict=True))
    return F, error


def _diagonal_of_inverse(S: Operator, probes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """diag(S^-1) and its standard error, (N,) each; what the solves left is part of the error."""
    n, rng = S.shape[0], np.random.default_rng(seed)
    total, squares, worst = np.zeros(n), np.zeros(n), 0.0
    for start in range(0, probes, _TOGETHER):
        signs = rng.integers(0, 2, (n, min(_TOGETHER, probes - start))).astype(np.float32) * 2 - 1
        x, residual = _solve(S, S.device.upload(signs))
        samples = signs * x.get().astype(np.float64)
        total += samples.sum(axis=1)
        squares += (samples**2).sum(axis=1)
        worst = max(worst, residual)
    mean = total / probes
    variance = np.maximum(squares - probes * mean**2, 0.0) / (probes - 1)
    return mean, np.hypot(np.sqrt(variance / probes), worst)


def _solve(S: Operator, b: Array) -> tuple[Array, float]:
    """S^-1 b and its largest relative residual, by as many Chebyshev steps as theory says.

    `ltcl.solvers` stands above `Transport`, which needs this; see `solvers/chebyshev.py` for the method
    with a stopping rule.
    """
    lower, upper = theory.free_bounds(S)
    centre, radius = (upper + lower) / 2, max((upper - lower) / 2, 1e-6 * (upper + lower))
    x, r = vectors.fill(b.like(), 0.0), b.copy()
    rho = radius / centre
    d = vectors.axpby(1.0 / centre, r, 0.0, r, r.like())
    for _ in range(theory.chebyshev_products(lower, upper, _RTOL) + 1):
        vectors.axpy(1.0, d, x)
        S.apply(x, r, scale=-1.0, add=b)
        previous, rho = rho, 1.0 / (2.0 * centre / radius - rho)
        vectors.axpby(2.0 * rho / radius, r, rho * previous, d, d)
    residual = float(np.max(vectors.norm(r) / vectors.norm(b)))
    if not residual <= 100 * _RTOL:
        raise InputError(
            f"first_bounce is 'estimate', whose solves ended at a relative residual of {residual:.2g}; T is "
            "far from that of a diffuse scene; give 'diagonal' or an array (N,)"
        )
    return x, residual
