# SPDX-License-Identifier: BSD-3-Clause
"""Whether a measured T conserves energy, and how much of it is below zero, which only noise can be.

A = I - S^-1 costs one solve to sum by rows: A 1 = 1 - S^-1 1. Row i of one bounce sums to the albedo of
pixel i times the share of its view that the projector lights, in [0, 1) whatever the areas. Columns of R sum
to what comes back of light from one pixel, at most m / (1 - m) between pixels of equal area (eq. 14).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import IdentityPlus, Operator
from ltcl.solvers import solve

_RTOL, _MAXITER = 1e-4, 200


@dataclass(frozen=True)
class Energy:
    """Checks of one channel; NaN where the operator cannot tell, or the solve did not converge.

    Attributes
    ----------
    bounce_lowest, bounce_highest : float
        Smallest and largest row sum of A. No albedo is below the largest; 1 or more, or clearly less than 0,
        is against physics: a wrong first bounce, ambient light left in T, or saturation.
    albedo_from_columns : float
        c / (1 + c), c the largest column sum of R: below 1 by form, and the albedo of a closed room of
        equal pixels that returns so much.
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
        """Whether every pixel gives back less light than it gets; False where unknown."""
        return self.bounce_highest < 1.0


def check(T: Any, F: np.ndarray, S: IdentityPlus) -> Energy:
    """The energy of T (N, N) with first bounce F (N,), 0 at masked pixels, and its S on the device.

    Examples
    --------
    >>> import ltcl
    >>> scene = ltcl.scenes.box(3, albedo=0.4)  # closed: every row of A sums to 0.4
    >>> T = scene.transport(first_bounce=scene.first_bounce)
    >>> round(check(T.matrices[0], T.first_bounce, T.interreflection).bounce_highest, 2)
    0.4
    """
    lit = F > 0
    once = _one_bounce(S)[lit]
    return Energy(float(once.min()), float(once.max()), _from_columns(T, F, lit), *_negative(T, F))


def _one_bounce(S: IdentityPlus) -> np.ndarray:
    """A 1 = 1 - S^-1 1, (N,)."""
    ones = np.ones(S.shape[0])
    solved = solve(S.as_it_stands(), ones, "chebyshev", rtol=_RTOL, maxiter=_MAXITER, throw=False)
    return ones - solved.x if solved.converged else np.full(S.shape[0], np.nan)


def _from_columns(T: Any, F: np.ndarray, lit: np.ndarray) -> float:
    if isinstance(T, Operator):
        try:
            sums = T.rmatvec(np.ones(len(F)))
        except InputError:  # of those that have no transpose
            return float("nan")
    elif isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        sums = np.asarray(T.sum(axis=0, dtype=np.float64))
    else:
        return float("nan")
    sums = sums[lit] / F[lit] - 1.0
    largest = max(float(sums.max()), 0.0)
    return largest / (1.0 + largest)


def _negative(T: Any, F: np.ndarray) -> tuple[float, float]:
    if not isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        return float("nan"), float("nan")
    entries = T if isinstance(T, np.ndarray) else T.data
    below = entries[entries < 0.0]
    lost, total = float(np.abs(below).sum(dtype=np.float64)), float(entries.sum(dtype=np.float64))
    return below.size / F.size**2, lost / (total + 2.0 * lost) if lost else 0.0
