# SPDX-License-Identifier: BSD-3-Clause
"""From walls to a scene: patches, their areas, form factors and albedos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device
from ltcl.scenes import walls as cube
from ltcl.scenes.blocks import Block
from ltcl.scenes.exchange import occlusion
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
    occluder: Block | None = None,
    device: Device | str | None = None,
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
    occluder : Block, optional
        In the unit cube only: it shades, and its faces follow the walls in the picture if it has an albedo.
    device : Device or str, optional
        What traces the rays past the occluder.

    Raises
    ------
    InputError
        If n or albedo is out of range, or albedo has another shape, or the occluder reaches out of the cube.
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
    blocks = () if occluder is None else (occluder,)
    faces = tuple(face for block in blocks for face in occlusion.lit_faces(block))
    every = (*walls, *faces)
    pixels = n * n * len(every)
    # Form factors, transport, its copy for the device, and room to work.
    checks.fits_host(f"{name}, {pixels} x {pixels}, with its transport,", 4 * 8 * pixels**2)
    patches = spread_albedo(albedo, len(walls), n)
    if occluder is None:
        factors = form_factors(walls, n)
    else:
        patches = _with_faces(patches, occluder, len(faces), n)
        factors = occlusion.form_factors(walls, faces, occluder, n, device)
    areas = np.tile(np.repeat([wall.area / n**2 for wall in every], n), n)
    return Scene(name, (n, len(every) * n), factors, patches, areas, every, viewer, blocks)


def _with_faces(patches: np.ndarray, block: Block, faces: int, n: int) -> np.ndarray:
    """Albedo of the walls' patches (channels, N), and of the block's faces behind them."""
    if not faces:
        return patches
    own = spread_albedo(np.repeat(np.reshape(block.albedo, (1, -1)), faces, axis=0), faces, n)
    channels = max(len(patches), len(own))
    parts = [
        np.broadcast_to(albedo.reshape(len(albedo), n, -1, n), (channels, n, albedo.shape[1] // n**2, n))
        for albedo in (patches, own)
    ]
    return np.concatenate(parts, axis=2).reshape(channels, -1)
