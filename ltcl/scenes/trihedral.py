# SPDX-License-Identifier: BSD-3-Clause
"""Three walls that meet in a point: a room corner that opens or closes.

The walls are rhombs, spanned by three unit edges with the same angle between any two. The angle of
90 degrees gives the corner of a cube, 120 a flat hexagon, and towards 0 a narrow tube.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.scenes.exchange import oblique
from ltcl.scenes.exchange.assembly import assemble
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall, vector


def trihedral(n: int, albedo: Any = 0.7, angle: float = 90.0) -> Scene:
    """Three rhombic walls with unit edges that meet in a point, n x n patches each.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        A scalar; (1, 3), one colour; (3, 1), one per wall; (3, 3), one colour per wall.
    angle : float
        Between any two of the three edges, in degrees, above 0 and below 120.

    Returns
    -------
    Scene
        Grid (n, 3n): left wall, right wall, floor. At 90 degrees that is `box(n, sides=3)`.

    Raises
    ------
    InputError
        If n, albedo or angle is out of range, or albedo has another shape.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host; nothing is allocated then.

    Notes
    -----
    Exact form factors, see `ltcl.scenes.exchange.oblique`.

    Examples
    --------
    >>> scene = trihedral(4, albedo=0.5, angle=60)
    >>> scene.grid, float(scene.area.sum().round(4))  # three rhombs of sin(60 degrees)
    ((4, 12), 2.5981)
    """
    angle = checks.number("angle", angle, above=0, below=120)
    edges = _edges(angle)
    middle = np.sum(edges, axis=0)
    viewer = Viewer(vector(middle / 3 + 3.3 * middle / np.linalg.norm(middle)), vector(middle / 3))
    return assemble(
        f"trihedral of {angle:g} degrees", _walls(*edges), n, albedo, viewer, oblique.form_factors
    )


def _edges(angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit edges to the left, to the right and up, mirrored at the plane x = y."""
    cos, sin = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    # Of the horizontal parts, whose length is sin: cos = cos^2 + sin^2 cos(turn).
    turn = math.acos(cos / (1 + cos))
    left, right = math.pi / 4 - turn / 2, math.pi / 4 + turn / 2
    return (
        np.array([sin * math.cos(left), sin * math.sin(left), cos]),
        np.array([sin * math.cos(right), sin * math.sin(right), cos]),
        np.array([0.0, 0.0, 1.0]),
    )


def _walls(left: np.ndarray, right: np.ndarray, up: np.ndarray) -> tuple[Wall, Wall, Wall]:
    return (
        Wall("left", corner=vector(left + up), right=vector(-left), down=vector(-up)),
        Wall("right", corner=vector(up), right=vector(right), down=vector(-up)),
        Wall("floor", corner=(0.0, 0.0, 0.0), right=vector(right), down=vector(left)),
    )
