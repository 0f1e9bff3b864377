# SPDX-License-Identifier: BSD-3-Clause
"""How many samples a product needs for the noise of an iteration, l = b - R l with R l sampled, to die away.

With s samples of each row, C the covariance of l and m its mean, an iteration makes of it

    C' = R C R^T + diag(Q p - diag(R C R^T) - (R m)^2) / s,    p = diag C + m^2

since rows are drawn on their own; Q as in `ltcl.theory.walks`, q = 1. Where rho(R) < 1, the part R C R^T
makes of noise with variances d the variances W d, W the sum over k >= 0 of the squared entries of R^k. Each
part keeps covariances positive semidefinite, hence (as for a regular splitting of an M-matrix: Varga, Matrix
Iterative Analysis, section 3.6) the noise stays bounded if and only if

    rho(H) < s,    H = Q W - W + I >= 0,    (N, N)

No term is dropped. By Cauchy and Schwarz diag(R C R^T) <= Q diag C, so that rho(Q) < 1 is enough for any s.
"""

from __future__ import annotations

import math

import numpy as np

from ltcl.operators import Operator

_EXACT = 256  # pixels up to which each has a probe of its own
_PROBES = 32
_MARGIN = {True: 1.01, False: 1.1}  # for the rounding of float32, and for the spread of random probes
_POWERS = 1000  # of R; W must have settled by then
_NEGLIGIBLE = 1e-4  # share of the last power in W d
_ROUNDS = 40  # of the power iteration on H


def least_samples(R: Operator, Q: Operator) -> float:
    """The least s whose noise dies away, infinite where W does not settle.

    By power iteration on H. Up to 256 pixels W d is summed exactly; of more, by 32 random signs, with a tenth
    to spare.

    Parameters
    ----------
    R, Q : Operator, (N, N)

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> R = [[0.0, 0.5], [0.5, 0.0]]
    >>> least_samples(as_operator(R), as_operator([[0.0, 0.25], [0.25, 0.0]]))
    1.0
    """
    n, rng = R.shape[0], np.random.default_rng(0)
    d, radius = np.ones(n), math.nan
    for _ in range(_ROUNDS):
        c = _variances(R, d, rng)
        if not np.all(np.isfinite(c)):
            return math.inf
        h = np.maximum(Q.apply(Q.device.upload(c)).get() - c + d, 0.0)
        before, radius = radius, float(np.sum(h) / np.sum(d))
        if radius == 0.0 or not math.isfinite(radius):
            break
        d = h / radius + d  # with a part of the last, which settles where -rho(H) is an eigenvalue as well
        d *= n / np.sum(d)
        if abs(radius - before) < 1e-3 * radius:
            break
    spare = radius * _MARGIN[n <= _EXACT]
    return math.floor(spare) + 1.0 if math.isfinite(spare) else math.inf


def noise_of_iteration(Q: Operator, least: float, radius: float) -> float:
    """About the noise that an iteration with the `least` samples ends with, in units of the light.

    One product makes of light p = 1 variances of about rho(Q) / s, and the iteration multiplies them by
    1 / (1 - rho(H) / s); `radius` is rho(Q). Of rho(H) only the margin is known that `least` leaves.

    >>> from ltcl.operators import as_operator
    >>> round(noise_of_iteration(as_operator([[0.0, 0.25], [0.25, 0.0]]), 1.0, 0.25), 2)
    0.7
    """
    share = (least - 0.5) / (least * _MARGIN[Q.shape[0] <= _EXACT])
    return math.sqrt(radius / least / (1.0 - share))


def _variances(R: Operator, d: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """W d, of variances d >= 0; infinite where the powers of R do not fall."""
    n = len(d)
    probes, share = (np.eye(n), 1.0) if n <= _EXACT else (rng.choice((-1.0, 1.0), (n, _PROBES)), 1 / _PROBES)
    x = R.device.upload(np.sqrt(d)[:, None] * probes)
    y, found = x.like(), np.zeros(n)
    for _ in range(_POWERS):
        added = share * np.sum(x.get().astype(np.float64) ** 2, axis=1)
        found += added
        if not np.sum(added) > _NEGLIGIBLE * np.sum(found):
            return found
        R.apply(x, y)
        x, y = y, x
    return np.full(n, np.inf)
