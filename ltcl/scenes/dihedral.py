# SPDX-License-Identifier: BSD-3-Clause
"""Two walls at a right angle: the scene of figure 9, and the smallest one with all that matters.

Odd bounces of light cast on one wall show on the other wall only, even ones on the first.
"""

from __future__ import annotations

from typing import Any

from ltcl.scenes.box import WALLS, cube_faces
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer


def dihedral(n: int, albedo: Any = 0.7) -> Scene:
    """Two unit square walls that meet in an upright edge, n x n square patches each.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        A scalar; (2,), one per wall; (3,), one colour; (2, 3), one colour per wall.

    Returns
    -------
    Scene
        Grid (n, 2n): the left half is the left wall, the right half the right one, and the seam runs
        down the middle, as a viewer who faces the corner sees it unfolded.

    Raises
    ------
    InputError
        If n or albedo is out of range, or albedo has another shape.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host; nothing is allocated then.

    Notes
    -----
    Figure 9 of the paper. Exact form factors, see `ltcl.scenes.cube_tables`.

    Examples
    --------
    >>> scene = dihedral(4, albedo=0.5)
    >>> scene.grid, float(scene.A[0, 1])  # patches of one wall do not see each other
    ((4, 8), 0.0)
    """
    viewer = Viewer(eye=(2.2, 2.2, 0.5), target=(0, 0, 0.5))
    return cube_faces("dihedral", WALLS[:2], n, albedo, viewer)
