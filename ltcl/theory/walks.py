# SPDX-License-Identifier: BSD-3-Clause
"""Where random walks have a mean and a variance, and how long they should be; where sampled products settle.

The weight of a walk that goes on with chance q after each step has second moments that grow like
powers of

    Q / q,  Q_ij = R_ij^2 / p(j | i),  which is |R_i| |R_ij| where entries are drawn in proportion (eq. 25)

so that its variance is finite where rho(Q) < q. Whenever it is, rho(|R|) < 1 too, and the mean exists: by
Cauchy and Schwarz rho(|R|)^2 <= rho(Q).

An iteration l = b - R l whose product is sampled, s samples of each row, makes of the covariance C
of l

    C' = R C R^T + diag(Q diag C - diag(R C R^T) + what the mean of l adds) / s

since rows are drawn on their own. Hence trace C' <= ((1 - 1/s) ||R||_2^2 + ||Q||_1 / s) trace C + ..., and
noise dies away where the bracket is below 1, and, with any s, where rho(Q) < 1, as diag(R C R^T) <=
Q diag C.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ltcl.operators import CSR, Dense
from ltcl.operators.walks import Tables
from ltcl.theory.norms import two_norm
from ltcl.theory.spectrum import spectral_radius

LONGEST = 0.9999  # chance to go on; beyond, walks of many thousand steps would carry nothing
_SHORTEST = (
    1 / 16
)  # below, terms that matter little are seen so rarely that nobody can tell their error
_LONG = (
    3 / 4
)  # for heavy rows alone; beyond, walks from b, which score where they end, lose too much


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
    if "weights" not in tables.moments:
        Qs = tables.second_moments(R)
        radius = float(np.max([spectral_radius(Q).value for Q in Qs]))
        tables.moments["weights"] = Weights(
            radius, np.stack([Q.row_sums().astype(np.float64) for Q in Qs])
        )
    return tables.moments["weights"]


def chance_to_go_on(step: Weights, albedo: float | None) -> float:
    """q = m / (1 - m) of eq. 24; where no albedo m is given sqrt(rho(Q)), at which rho(Q) / q = q.

    For equal row sums that is rho(R), hence the m of a closed scene (eq. 14). Light that goes one
    way has a lower rho(Q), down to 0: q is then the root of the heaviest row of Q, up to 3/4, so
    that weights do not grow while walks become rare.

    >>> chance_to_go_on(Weights(0.25, np.array([[0.25, 0.25]])), None)
    0.5
    """
    if albedo is not None:
        return albedo / (1.0 - albedo)
    heaviest = math.sqrt(float(np.max(step.mean_square, initial=0.0)))
    return max(math.sqrt(step.radius), min(heaviest, _LONG), _SHORTEST)


def has_variance(radius: float, q: float) -> bool:
    """Whether the variance of walks is finite; not where moments overflow, and `radius` is NaN."""
    return radius < q <= LONGEST


def enough_samples(Rs: Sequence[CSR | Dense], tables: Tables) -> float:
    """Samples of a row from which on the noise of sampled products by all Rs dies away; kept with the tables.

    Infinite where a ||R||_2 >= 1.

    >>> from ltcl.operators import as_operator
    >>> from ltcl.operators.walks import tables
    >>> R = as_operator([[0.0, 0.5], [0.5, 0.0]])
    >>> enough_samples([R], tables(R))  # one is enough
    1.0
    """
    if "enough" not in tables.moments:
        squares = np.array([two_norm(R).upper ** 2 for R in Rs])
        most = np.array([Q.norms().one for Q in tables.second_moments(Rs[0])])
        enough = np.floor(np.maximum(most - squares, 0.0) / np.maximum(1.0 - squares, 1e-300)) + 1.0
        tables.moments["enough"] = float(np.max(np.where(squares < 1.0, enough, np.inf)))
    return tables.moments["enough"]
