# SPDX-License-Identifier: BSD-3-Clause
"""Conditions for random walks to have a mean and a variance, and for sampled products to settle.

**Walks.** The weight of a walk that goes on with chance q after each step has second moments that
grow like powers of

    Q / q,    Q_ij = R_ij^2 / p(j | i)

which is |R_i| |R_ij| if entries are drawn in proportion (eq. 25). Its variance is finite if
rho(Q) < q. Then rho(|R|) < 1 too, and the mean exists: by Cauchy and Schwarz rho(|R|)^2 <= rho(Q).

**Sampled products.** An iteration l = b - R l whose product is sampled, with s samples of each row,
turns the covariance C of l into

    C' = R C R^T + diag(Q diag C - diag(R C R^T) + a term of the mean of l) / s

since rows are drawn independently. Hence

    trace C' <= ((1 - 1/s) ||R||_2^2 + ||Q||_1 / s) trace C + ...

and noise decays if the bracket is below 1, and, with any s, if rho(Q) < 1, as diag(R C R^T) <=
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

# Largest chance to go on: beyond, walks of many thousand steps would carry nothing.
LONGEST = 0.9999
# Least chance: below, terms that matter little are seen so rarely that their error is unknown.
SHORTEST = 1 / 16
# Largest chance for heavy rows alone: beyond, walks from b, which score where they end, lose too
# much.
LONGEST_FOR_HEAVY_ROWS = 3 / 4


class Weights(NamedTuple):
    """Second moments of the weights of one step.

    Attributes
    ----------
    radius : float
        rho(Q), the largest of all channels.
    mean_square : (channels, N)
        Q 1, the mean square of each row.
    """

    radius: float
    mean_square: np.ndarray


def weights(R: CSR | Dense, tables: Tables) -> Weights:
    """Second moments of walks over these tables of R, by power iteration; kept with the tables.

    >>> import ltcl
    >>> from ltcl.operators.walks import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [-0.5, 0.0]])
    >>> round(weights(R, tables(R)).radius, 6), weights(R, tables(R)).mean_square.tolist()
    (0.25, [[0.25, 0.25]])
    """
    if "weights" not in tables.moments:
        radii = []
        row_sums = []
        for Q in tables.second_moments(R):
            radii.append(spectral_radius(Q).value)
            row_sums.append(Q.row_sums().astype(np.float64))
        tables.moments["weights"] = Weights(float(np.max(radii)), np.stack(row_sums))
    return tables.moments["weights"]


def chance_to_go_on(step: Weights, albedo: float | None) -> float:
    """The chance q = m / (1 - m) of eq. 24; without an albedo m it is sqrt(rho(Q)).

    Then rho(Q) / q = q. For equal row sums that is rho(R), hence the m of a closed scene (eq. 14).
    Light that goes one way has a lower rho(Q), down to 0: q is then the root of the heaviest row of
    Q, up to 3/4, so that weights do not grow while walks become rare.

    >>> chance_to_go_on(Weights(0.25, np.array([[0.25, 0.25]])), None)
    0.5
    """
    if albedo is not None:
        return albedo / (1.0 - albedo)
    heaviest = math.sqrt(float(np.max(step.mean_square, initial=0.0)))
    return max(math.sqrt(step.radius), min(heaviest, LONGEST_FOR_HEAVY_ROWS), SHORTEST)


def has_variance(radius: float, q: float) -> bool:
    """True if the variance of walks is finite; False if moments overflow, and `radius` is NaN."""
    return radius < q <= LONGEST


def enough_samples(Rs: Sequence[CSR | Dense], tables: Tables) -> float:
    """Samples of a row that make the noise of sampled products by all Rs decay.

    Kept with the tables. Infinite if some ||R||_2 >= 1.

    >>> from ltcl.operators import as_operator
    >>> from ltcl.operators.walks import tables
    >>> R = as_operator([[0.0, 0.5], [0.5, 0.0]])
    >>> enough_samples([R], tables(R))  # one is enough
    1.0
    """
    if "enough" not in tables.moments:
        squares = np.array([two_norm(R).upper ** 2 for R in Rs])
        moments = np.array([Q.norms().one for Q in tables.second_moments(Rs[0])])
        # The least s with (1 - 1/s) ||R||^2 + ||Q||_1 / s < 1.
        quotient = np.maximum(moments - squares, 0.0) / np.maximum(1.0 - squares, 1e-300)
        samples = np.floor(quotient) + 1.0
        tables.moments["enough"] = float(np.max(np.where(squares < 1.0, samples, np.inf)))
    return tables.moments["enough"]
