# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of walls: a box, two walls at an angle, three that meet in a point (figures 4, 5 and 9).

A block in a box: F_ij = V_ij F'_ij, with F' of the empty room exact and V the share of rays between
i and j that pass. Only pairs of room patches need rays: of the room a face of the block sees what
is in front of its plane, and as the block is convex, nothing of it is in between. V is found with
256 rays a pair. In closed rooms rows sum to 1 within 0.5 % from 8 patches along a wall on, 1 % at
4. Where a row came to more, its entries are scaled down, each by the smaller factor of its two
patches: no row makes light, and reciprocity stays exact. Patches under a block that stands on them
are dark: no light reaches or leaves them, but what a projector throws there.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes import exchange
from ltcl.scenes.camera import SceneCamera
from ltcl.scenes.patches import cut
from ltcl.scenes.scene import Scene
from ltcl.scenes.visibility import visibility
from ltcl.scenes.walls import Block, Wall, spread_albedo, vector

WALLS = (
    Wall("left", corner=(1, 0, 1), right=(-1, 0, 0), down=(0, 0, -1)),
    Wall("right", corner=(0, 0, 1), right=(0, 1, 0), down=(0, 0, -1)),
    Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0)),
    Wall("ceiling", corner=(0, 0, 1), right=(1, 0, 0), down=(0, 1, 0)),
    Wall("near right", corner=(0, 1, 1), right=(1, 0, 0), down=(0, 0, -1)),
    Wall("near left", corner=(1, 1, 1), right=(0, -1, 0), down=(0, 0, -1)),
)
"""Faces of the unit cube from inside, in the order of `box`; its far upright edge is the z axis."""

FROM_ABOVE = SceneCamera(eye=(2.6, 2.6, 2.1), target=(0, 0, 0.25))
AT_EYE_LEVEL = SceneCamera(eye=(2.6, 2.6, 0.5), target=(0, 0, 0.5))
# Points along a patch: 256 rays between two patches past a block.
BLOCK_SAMPLES = 16
# A block that reaches out of the cube by less is within it, to rounding.
CUBE_TOLERANCE = 1e-9


def box(
    n: int,
    sides: int = 6,
    albedo: Any = 0.7,
    occluder: Block | None = None,
    device: Device | str | None = None,
) -> Scene:
    """A unit cube with some of its walls, n x n square patches each, and what stands in it.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    sides : int
        Walls present, 1 to 6: left, right, floor, ceiling, near right (faces left), near left.
        Three make a room corner, five an open box, six a closed one. One wall alone has no
        interreflection (A = 0).
    albedo : array_like in [0, 1)
        A scalar; (sides,), one per wall; (3,), one colour; (sides, 3), one colour per wall. With
        three sides, three numbers could mean both and are refused: write (3, 1) or (1, 3).
    occluder : Block, optional
        An opaque block inside the cube, which it may touch. It casts shadows; if it has an albedo,
        its faces are part of the picture, except those that lie in a wall.
    device : Device or str, optional
        The device that traces rays past the occluder; the best one if omitted. Without an occluder
        none is opened.

    Returns
    -------
    Scene
        Grid (n, sides * n), walls side by side in the order above, then the faces of the occluder
        in the order of `Block.faces`, n x n patches each. The floor's left edge meets the left wall
        and its top edge the right one; the ceiling's are the other way round.

    Raises
    ------
    InputError
        If n or sides or albedo is out of range, or albedo has another shape, or the occluder
        reaches out of the cube.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host; nothing is allocated
        then.

    Notes
    -----
    Figures 4 and 5 of the paper. Exact form factors, see `ltcl.scenes.exchange`; past an occluder
    they are sampled.

    Examples
    --------
    >>> room = box(4, sides=3, albedo=[(0.7, 0.1, 0.1), (0.1, 0.7, 0.1), (0.6, 0.6, 0.6)])
    >>> room.grid, room.channels, [wall.name for wall in room.walls]
    ((4, 12), 3, ['left', 'right', 'floor'])
    >>> table = Block(corner=(0.3, 0.3, 0), size=(0.4, 0.4, 0.3), albedo=0.5)
    >>> box(4, sides=3, occluder=table).grid
    (4, 32)
    """
    sides = checks.count("sides", sides, most=len(WALLS))
    # From above a ceiling would show its back, and walls alone look best at eye level.
    viewer = FROM_ABOVE if sides == 3 else AT_EYE_LEVEL
    if not isinstance(occluder, Block | None):
        raise InputTypeError(f"occluder is {occluder!r}; it must be an ltcl.scenes.Block")
    name = f"box with {sides} side(s)"
    if occluder is not None:
        name += " and a block"
    return _assemble(name, WALLS[:sides], n, albedo, viewer, occluder, device)


def dihedral(n: int, albedo: Any = 0.7, angle: float = 90.0) -> Scene:
    """Two unit square walls that meet in an upright edge, n x n square patches each.

    Odd bounces of light cast on one wall show on the other wall only, even ones on the first.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        A scalar; (2,), one per wall; (3,), one colour; (2, 3), one colour per wall.
    angle : float
        Angle between the walls, in degrees, above 0 and below 180. The smaller, the more light
        stays inside.

    Returns
    -------
    Scene
        Grid (n, 2n): the left half is the left wall, the right half the right one, and the seam
        runs down the middle, as a viewer who faces the corner sees it unfolded.

    Raises
    ------
    InputError
        If n, albedo or angle is out of range, or albedo has another shape.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host; nothing is allocated
        then.

    Notes
    -----
    Figure 9 of the paper. Exact form factors, see `ltcl.scenes.exchange`.

    Examples
    --------
    >>> scene = dihedral(4, albedo=0.5)
    >>> scene.grid, float(scene.A[0, 1])  # patches of one wall do not see each other
    ((4, 8), 0.0)
    >>> bool(dihedral(4, angle=30).form_factors.sum() > scene.form_factors.sum())
    True
    """
    angle = checks.number("angle", angle, above=0, below=180)
    viewer = SceneCamera(eye=(2.2, 2.2, 0.5), target=(0, 0, 0.5))
    if angle == 90:
        return _assemble("dihedral", WALLS[:2], n, albedo, viewer)
    # Both walls are turned about the z axis, away from the viewer's line of sight by the same
    # angle.
    azimuth = math.radians(45 - angle / 2)
    x = math.cos(azimuth)
    y = math.sin(azimuth)
    walls = (
        Wall("left", corner=(x, y, 1), right=(-x, -y, 0), down=(0, 0, -1)),
        Wall("right", corner=(0, 0, 1), right=(y, x, 0), down=(0, 0, -1)),
    )
    return _assemble(f"dihedral of {angle:g} degrees", walls, n, albedo, viewer)


def trihedral(n: int, albedo: Any = 0.7, angle: float = 90.0) -> Scene:
    """Three rhombic walls with unit edges that meet in a point, n x n patches each.

    Parameters
    ----------
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        A scalar; (1, 3), one colour; (3, 1), one per wall; (3, 3), one colour per wall.
    angle : float
        Angle between any two of the three edges, in degrees, above 0 and below 120. 90 gives the
        corner of a cube, 120 would be a flat hexagon, and towards 0 it becomes a narrow tube.

    Returns
    -------
    Scene
        Grid (n, 3n): left wall, right wall, floor. At 90 degrees that is `box(n, sides=3)`.

    Raises
    ------
    InputError, MemoryLimitError
        Those of `dihedral`.

    Examples
    --------
    >>> scene = trihedral(4, albedo=0.5, angle=60)
    >>> scene.grid, float(scene.area.sum().round(4))  # three rhombs of sin(60 degrees)
    ((4, 12), 2.5981)
    """
    angle = checks.number("angle", angle, above=0, below=120)
    cos = math.cos(math.radians(angle))
    sin = math.sin(math.radians(angle))
    # The horizontal parts of the edges have length sin: cos = cos^2 + sin^2 cos(turn).
    turn = math.acos(cos / (1 + cos))

    def edge(azimuth: float) -> np.ndarray:
        return np.array([sin * math.cos(azimuth), sin * math.sin(azimuth), cos])

    left = edge(math.pi / 4 - turn / 2)
    right = edge(math.pi / 4 + turn / 2)
    up = np.array([0.0, 0.0, 1.0])
    walls = (
        Wall("left", corner=vector(left + up), right=vector(-left), down=vector(-up)),
        Wall("right", corner=vector(up), right=vector(right), down=vector(-up)),
        Wall("floor", corner=(0.0, 0.0, 0.0), right=vector(right), down=vector(left)),
    )
    diagonal = left + right + up
    target = diagonal / 3
    eye = target + 3.3 * diagonal / np.linalg.norm(diagonal)
    viewer = SceneCamera(vector(eye), vector(target))
    return _assemble(f"trihedral of {angle:g} degrees", walls, n, albedo, viewer)


def _assemble(
    name: str,
    walls: tuple[Wall, ...],
    n: int,
    albedo: Any,
    viewer: SceneCamera,
    occluder: Block | None = None,
    device: Device | str | None = None,
) -> Scene:
    """Scene of walls with n x n patches each, and of a block in the unit cube."""
    n = checks.count("n", n)
    faces = () if occluder is None else _lit_faces(occluder)
    surfaces = (*walls, *faces)
    pixels = n * n * len(surfaces)
    # Form factors, transport, its copy for the device, and room to work.
    checks.fits_host(f"{name}, {pixels} x {pixels}, with its transport,", 4 * 8 * pixels**2)
    albedos = spread_albedo(albedo, len(walls), n)
    if occluder is None:
        factors = exchange.form_factors(walls, n)
        blocks = ()
    else:
        factors = _past_block(walls, faces, occluder, n, device)
        blocks = (occluder,)
        if faces:
            albedos = _with_block(albedos, len(walls), occluder.albedo, len(faces), n)
    patch_areas = [surface.area / n**2 for surface in surfaces]
    return Scene(
        name=name,
        grid=(n, len(surfaces) * n),
        form_factors=factors,
        albedo=albedos,
        area=np.tile(np.repeat(patch_areas, n), n),
        walls=surfaces,
        viewer=viewer,
        blocks=blocks,
    )


def _with_block(
    albedos: np.ndarray, walls: int, block_albedo: Any, faces: int, n: int
) -> np.ndarray:
    """Albedos of all patches (channels, n * walls * n), then those of the faces of a block."""
    of_walls = albedos.reshape(len(albedos), n, walls, n)[:, 0, :, 0].T
    of_block = np.atleast_1d(np.asarray(block_albedo, np.float64))
    channels = max(len(albedos), len(of_block))
    colours = [
        np.broadcast_to(of_walls, (walls, channels)),
        np.broadcast_to(of_block, (faces, channels)),
    ]
    return spread_albedo(np.concatenate(colours), walls + faces, n)


def _lit_faces(block: Block) -> tuple[Wall, ...]:
    """Faces of a block in the unit cube that light can meet.

    There are none if it is black, and none on the cube's faces.
    """
    low = block.low
    high = block.high
    if low.min() < -CUBE_TOLERANCE or high.max() > 1 + CUBE_TOLERANCE:
        raise InputError(
            f"occluder reaches from {vector(low)} to {vector(high)}, out of the room; "
            "it must stay within (0, 0, 0) and (1, 1, 1)"
        )
    if low.max() < CUBE_TOLERANCE and high.min() > 1 - CUBE_TOLERANCE:
        raise InputError("occluder fills the room; it must leave some of it free")
    if block.albedo is None:
        return ()
    # In the order of `Block.faces`: +x, -x, +y, -y, top, bottom.
    distances = np.stack([1 - high, low], axis=1).ravel()
    lit = []
    for face, distance in zip(block.faces(), distances, strict=True):
        if distance >= CUBE_TOLERANCE:
            lit.append(face)
    return tuple(lit)


def _past_block(
    walls: tuple[Wall, ...],
    faces: tuple[Wall, ...],
    block: Block,
    n: int,
    device: Device | str | None,
) -> np.ndarray:
    """Form factors (N, N) of a room and of the lit faces of a block in it, walls before faces."""
    surfaces = (*walls, *faces)
    room = len(walls)
    total = len(surfaces)
    matrix = np.zeros((n, total, n, n, total, n))
    exchange.fill(matrix, surfaces, itertools.combinations(range(room), 2))
    exchange.fill(matrix, surfaces, itertools.product(range(room), range(room, total)))
    boxes = [(block.low, block.high)]
    visible = visibility(cut(walls, n), boxes, device, samples=BLOCK_SAMPLES)
    matrix[:, :room, :, :, :room] *= visible.reshape(n, room, n, n, room, n)
    matrix = matrix.reshape(n * n * total, -1)
    scale = 1 / np.maximum(matrix.sum(axis=1), 1)
    for row, factor in zip(matrix, scale, strict=True):
        row *= np.minimum(scale, factor)
    return matrix
