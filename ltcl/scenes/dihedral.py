# SPDX-License-Identifier: BSD-3-Clause
"""Two walls at an angle: the scene of figure 9, and the smallest one with all that matters.

Odd bounces of light cast on one wall show on the other wall only, even ones on the first.
"""

from __future__ import annotations

import math
from typing import Any

from ltcl import checks
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange import oblique
from ltcl.scenes.exchange.assembly import assemble
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall


def dihedral(n: int, albedo: Any = 0.7, angle: float = 90.0) -> Scene:
    """Two unit square walls that meet in an upright edge, n x n square patches each.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        A scalar; (2,), one per wall; (3,), one colour; (2, 3), one colour per wall.
    angle : float
        Between the walls, in degrees, above 0 and below 180. The smaller, the more light stays inside.

    Returns
    -------
    Scene
        Grid (n, 2n): the left half is the left wall, the right half the right one, and the seam runs
        down the middle, as a viewer who faces the corner sees it unfolded.

    Raises
    ------
    InputError
        If n, albedo or angle is out of range, or albedo has another shape.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host; nothing is allocated then.

    Notes
    -----
    Figure 9 of the paper. Exact form factors, see `ltcl.scenes.exchange.cube_tables` for the right angle and
    `ltcl.scenes.exchange.oblique` for others.

    Examples
    --------
    >>> scene = dihedral(4, albedo=0.5)
    >>> scene.grid, float(scene.A[0, 1])  # patches of one wall do not see each other
    ((4, 8), 0.0)
    >>> bool(dihedral(4, angle=30).form_factors.sum() > scene.form_factors.sum())
    True
    """
    angle = checks.number("angle", angle, above=0, below=180)
    viewer = Viewer(eye=(2.2, 2.2, 0.5), target=(0, 0, 0.5))
    if angle == 90:
        return assemble("dihedral", WALLS[:2], n, albedo, viewer)
    return assemble(f"dihedral of {angle:g} degrees", _walls(angle), n, albedo, viewer, oblique.form_factors)


def _walls(angle: float) -> tuple[Wall, Wall]:
    """Both walls turned about the z axis, away from the viewer's line of sight by the same angle."""
    x, y = (math.cos(math.radians(45 - angle / 2)), math.sin(math.radians(45 - angle / 2)))
    return (
        Wall("left", corner=(x, y, 1), right=(-x, -y, 0), down=(0, 0, -1)),
        Wall("right", corner=(0, 0, 1), right=(y, x, 0), down=(0, 0, -1)),
    )
