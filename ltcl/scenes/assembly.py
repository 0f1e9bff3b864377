# SPDX-License-Identifier: BSD-3-Clause
"""From walls to a scene: patches, their areas, form factors and albedos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.scenes import walls as cube
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall, spread_albedo

FormFactors = Callable[[Sequence[Wall], int], np.ndarray]


def assemble(
    name: str,
    walls: tuple[Wall, ...],
    n: int,
    albedo: Any,
    viewer: Viewer,
    form_factors: FormFactors = cube.form_factors,
) -> Scene:
    """Scene of walls with n x n patches each; what `box`, `dihedral` and `trihedral` share.

    Parameters
    ----------
    name : str
    walls : tuple of Wall
        Faces of the unit cube, unless `form_factors` takes others.
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        As `ltcl.scenes.walls.spread_albedo` takes it.
    viewer : Viewer
    form_factors : callable
        What gives the (N, N) form factors of the walls' patches; exact tables for the unit cube.

    Raises
    ------
    InputError
        If n or albedo is out of range, or albedo has another shape.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host.

    Examples
    --------
    >>> from ltcl.scenes.box import WALLS
    >>> floor = assemble("floor", WALLS[2:3], 2, 0.5, Viewer(eye=(2, 2, 1), target=(0, 0, 0)))
    >>> floor.grid, floor.area.tolist()
    ((2, 2), [0.25, 0.25, 0.25, 0.25])
    """
    n = checks.count("n", n)
    pixels = n * n * len(walls)
    # Form factors, transport, its copy for the device, and room to work.
    checks.fits_host(f"{name}, {pixels} x {pixels}, with its transport,", 4 * 8 * pixels**2)
    patches = spread_albedo(albedo, len(walls), n)
    areas = np.tile(np.repeat([wall.area / n**2 for wall in walls], n), n)
    return Scene(name, (n, len(walls) * n), form_factors(walls, n), patches, areas, walls, viewer)
