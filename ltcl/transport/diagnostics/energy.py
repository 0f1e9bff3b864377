# SPDX-License-Identifier: BSD-3-Clause
"""Energy of a measured T = S F: no pixel gives back more light than it gets.

Row i of one bounce A sums to the albedo of pixel i times the share of its view that the projector
lights, in [0, 1) whatever the areas; A 1 = 1 - S^-1 1 costs one solve. Columns of R sum to the
light that returns from one pixel, at most m / (1 - m) between pixels of equal area (eq. 14).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import IdentityPlus
from ltcl.solvers import solve

# Solve for A 1.
SOLVE_RTOL = 1e-4
MAX_ITERATIONS = 200


@dataclass(frozen=True)
class Energy:
    """Checks of one channel; NaN if the operator cannot tell, or the solve did not converge.

    Attributes
    ----------
    bounce_lowest, bounce_highest : float
        Smallest and largest row sum of A. No albedo is below the largest; 1 or more, or clearly
        less than 0, is against physics: a wrong first bounce, ambient light left in T, or
        saturation.
    albedo_from_columns : float
        c / (1 + c), c the largest column sum of R: below 1 by form, and the albedo of a closed room
        of equal pixels that returns so much.
    negative_entries : float
        Share of the entries of T below zero.
    negative_light : float
        Their share of the sum of all absolute values.
    """

    bounce_lowest: float
    bounce_highest: float
    albedo_from_columns: float
    negative_entries: float
    negative_light: float

    @property
    def conserved(self) -> bool:
        """True if every pixel gives back less light than it gets; False if unknown."""
        return self.bounce_highest < 1.0


def check_energy(T: Any, F: np.ndarray, S: IdentityPlus) -> Energy:
    """The energy of T (N, N) with first bounce F (N,), 0 at masked pixels, and its S on the device.

    Examples
    --------
    >>> import ltcl
    >>> scene = ltcl.scenes.box(3, albedo=0.4)  # closed: every row of A sums to 0.4
    >>> T = scene.transport(first_bounce=scene.first_bounce)
    >>> round(check_energy(T.matrices[0], T.first_bounce, T.interreflection).bounce_highest, 2)
    0.4
    """
    is_lit = F > 0
    ones = np.ones(S.shape[0])
    solution = solve(
        S.as_it_stands(), ones, "chebyshev", rtol=SOLVE_RTOL, maxiter=MAX_ITERATIONS, throw=False
    )
    bounce = np.array([np.nan])
    if solution.converged:
        # A 1
        bounce = (ones - solution.x)[is_lit]
    negative_entries, negative_light = _negative_shares(T, F)
    return Energy(
        bounce_lowest=float(bounce.min()),
        bounce_highest=float(bounce.max()),
        albedo_from_columns=_albedo_from_columns(T, F, is_lit),
        negative_entries=negative_entries,
        negative_light=negative_light,
    )


def _albedo_from_columns(T: Any, F: np.ndarray, is_lit: np.ndarray) -> float:
    if isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        sums = T.sum(axis=0, dtype=np.float64)
    elif hasattr(T, "between"):
        try:
            sums = T.rmatvec(np.ones(len(F)))
        except InputError:
            # The operator has no transpose.
            return float("nan")
    else:
        return float("nan")
    largest = max(float(np.max(sums[is_lit] / F[is_lit])) - 1.0, 0.0)
    return largest / (1.0 + largest)


def _negative_shares(T: Any, F: np.ndarray) -> tuple[float, float]:
    """Share of entries below zero, and of the light in them."""
    if isinstance(T, np.ndarray):
        entries = T
    elif isinstance(T, scipy.sparse.csr_array):
        entries = T.data
    else:
        return float("nan"), float("nan")
    negative = entries[entries < 0.0]
    light = float(np.abs(negative).sum(dtype=np.float64))
    share = negative.size / F.size**2
    if light == 0.0:
        return share, 0.0
    total = float(entries.sum(dtype=np.float64)) + 2.0 * light
    return share, light / total
