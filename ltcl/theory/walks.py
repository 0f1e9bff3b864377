# SPDX-License-Identifier: BSD-3-Clause
"""Where random walks have a mean and a variance, and how long they should be; where sampled products settle.

The weight of a walk that goes on with chance q after each step has second moments that grow like powers of

    Q / q,  Q_ij = R_ij^2 / p(j | i),  which is |R_i| |R_ij| where entries are drawn in proportion (eq. 25)

so that its variance is finite where rho(Q) < q. Whenever it is, rho(|R|) < 1 too, and the mean exists: by
Cauchy and Schwarz rho(|R|)^2 <= rho(Q).

An iteration l = b - R l whose product is sampled, s samples of each row, makes of the covariance C of l

    C' = R C R^T + diag(Q diag C - diag(R C R^T) + what the mean of l adds) / s

since rows are drawn on their own. Hence trace C' <= ((1 - 1/s) ||R||_2^2 + ||Q||_1 / s) trace C + ..., and
noise dies away where the bracket is below 1, and, with any s, where rho(Q) < 1, as diag(R C R^T) <= Q diag C.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ltcl.operators import CSR, Dense, Operator
from ltcl.operators.walks import Tables
from ltcl.theory.norms import two_norm
from ltcl.theory.spectrum import spectral_radius

LONGEST = 0.9999  # chance to go on; beyond, walks of many thousand steps would carry nothing
_SHORTEST = 1 / 16  # below, terms that matter little are seen so rarely that nobody can tell their error


class Weights(NamedTuple):
    """Of a step: rho(Q), the largest of all channels, and Q 1, (channels, N), the mean square of each row."""

    radius: float
    mean_square: np.ndarray


def weights(R: CSR | Dense, tables: Tables) -> Weights:
    """Of walks over these tables of R, by power iteration; kept with the tables.

    >>> import ltcl
    >>> from ltcl.operators.walks import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [-0.5, 0.0]])
    >>> round(weights(R, tables(R)).radius, 6), weights(R, tables(R)).mean_square.tolist()
    (0.25, [[0.25, 0.25]])
    """
    if "weights" not in tables.kept:
        Qs = tables.second_moments(R)
        radius = float(np.max([spectral_radius(Q).value for Q in Qs]))
        tables.kept["weights"] = Weights(radius, np.stack([Q.row_sums().astype(np.float64) for Q in Qs]))
    return tables.kept["weights"]


def chance_to_go_on(radius: float, albedo: float | None) -> float:
    """q = m / (1 - m) of eq. 24; where no albedo m is given sqrt(radius), at which rho(Q) / q = q.

    For equal row sums that is rho(R), hence the m of a closed scene (eq. 14).

    >>> chance_to_go_on(0.25, None), round(chance_to_go_on(0.25, 0.3), 4)
    (0.5, 0.4286)
    """
    return max(math.sqrt(radius), _SHORTEST) if albedo is None else albedo / (1.0 - albedo)


def has_variance(radius: float, q: float) -> bool:
    """Whether the variance of walks is finite; not where moments overflow, and `radius` is NaN."""
    return radius < q <= LONGEST


def enough_samples(R: Operator, Q: Operator) -> float:
    """Samples of a row from which on the noise of a sampled product dies away; infinite of ||R||_2 >= 1.

    >>> from ltcl.operators import as_operator
    >>> R, Q = [[0.0, 0.5], [0.5, 0.0]], [[0.0, 4.0], [4.0, 0.0]]
    >>> enough_samples(as_operator(R), as_operator(Q))  # (4 - 1/4) / (1 - 1/4), and one more
    6.0
    """
    norm, most = two_norm(R).upper ** 2, Q.norms().one
    return math.floor(max(most - norm, 0.0) / (1.0 - norm)) + 1.0 if norm < 1.0 else math.inf
