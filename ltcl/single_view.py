# SPDX-License-Identifier: BSD-3-Clause
"""Whether one projector and one camera see the bounces: I - S^-1 must then be a bounce (section 8.4).

Of a Lambertian scene I - S^-1 = A (eq. 4), and A takes no light away from anywhere. One view of glossy
surfaces is T = P S F Q (eq. 28); what stands in the place of A then is no power of anything physical, and
has negative entries. They are counted between parts of the picture, 4 x 4 rectangles, over whose pixels the
noise of a measurement averages out; within a part, a biased first bounce makes negative entries, too.

Measured: 0 of diffuse boxes whatever their first bounce, 0.0004 of a path-traced diffuse corner; of a glossy
corner 0.005, 0.013, 0.034 and 0.13 with shares of 0.05, 0.1, 0.2 and 0.4 of glossy reflection.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from ltcl.errors import ConvergenceError
from ltcl.operators import IdentityPlus
from ltcl.solvers import solve
from ltcl.transport import Transport

_PARTS = 4  # along each side of the picture
_KNOWN: WeakKeyDictionary[Transport, tuple[float, ...]] = WeakKeyDictionary()


def negative_bounces(T: Transport) -> tuple[float, ...]:
    """Share of light that one bounce between parts of the picture would take away: 0 of a Lambertian scene.

    One for each channel, in [0, 1]; NaN where no method solves with S. Found once for each T, by a few
    products with 16 right-hand sides.

    Examples
    --------
    >>> from ltcl.scenes import dihedral
    >>> negative_bounces(dihedral(4).transport())[0] < 1e-3
    True
    """
    if T not in _KNOWN:
        parts = _parts(T.grid)
        _KNOWN[T] = tuple(_share(S, parts) for S in T.systems)
    return _KNOWN[T]


def _parts(grid: tuple[int, int]) -> np.ndarray:
    """Indicators (N, parts) of rectangles that cover the picture."""
    rows, columns = (np.arange(size) * min(_PARTS, size) // size for size in grid)
    number = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    return (number[:, None] == np.arange(number[-1] + 1)).astype(np.float64)


def _share(S: IdentityPlus, parts: np.ndarray) -> float:
    try:
        bounced = parts - solve(S.as_it_stands(), parts, rtol=1e-3).x  # A e for the indicator e of each part
    except ConvergenceError:
        return float("nan")
    between = parts.T @ bounced
    np.fill_diagonal(between, 0.0)
    light = np.abs(between).sum()
    return float(np.abs(between[between < 0.0]).sum() / light) if light > 0.0 else 0.0
