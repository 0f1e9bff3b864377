# SPDX-License-Identifier: BSD-3-Clause
"""Rooms of glossy walls with one projector and one camera: puts together what `light_field` computes with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.blocks import Block, point
from ltcl.scenes.gloss import beams, brdf
from ltcl.scenes.gloss import directions as hemisphere
from ltcl.scenes.gloss.light_field import GlossyScene
from ltcl.scenes.gloss.sight import Sight, sight
from ltcl.scenes.patches import cut
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall, spread_albedo, vector


def glossy(
    room: Scene | Sequence[Wall],
    n: int,
    albedo: Any = 0.7,
    gloss: Any = 0.5,
    exponent: Any = 20.0,
    *,
    projector: Any,
    camera: Any = None,
    directions: int = 64,
    rays: int = 64,
    blocks: Sequence[Block] = (),
    seed: int = 0,
) -> GlossyScene:
    """A room of glossy walls, n x n patches each, with the place of one projector and one camera.

    Parameters
    ----------
    room : Scene or sequence of Wall
        The walls and blocks of a scene, or any walls. The faces of a block reflect where they are among the
        walls, as in ``box(1, sides=3, occluder=Block(..., albedo=0.5))``.
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        As `box` takes it: a scalar, one per wall, one colour, or one colour per wall.
    gloss : array_like in [0, 1]
        Share of the reflected light that the lobe takes; a scalar or one per wall. 0 is matte.
    exponent : array_like, above 0
        Of the lobe, see `brdf`; a scalar or one per wall, at most 8 * directions.
    projector, camera : (3,)
        Where they stand. The camera of a scene stands where its viewer does, unless given.
    directions : int
        Bins over each patch, M: a square number of at least 4.
    rays : int
        Followed from each bin of each patch.
    blocks : sequence of Block
        What else stands in the room. Faces that are not among the walls are black.
    seed : int
        Of the rays.

    Returns
    -------
    GlossyScene
        Grid (n, n * walls), walls side by side.

    Raises
    ------
    InputError
        If a number is out of range, or projector or camera see no wall from its front.
    MemoryLimitError
        If the light field does not fit in the memory of the host; nothing is allocated then.

    Notes
    -----
    Errors of the rays fall with `rays`, those of the bins with `directions`. For gloss 0 bins do not matter:
    then this is the diffuse scene, with form factors found by rays (about 2 % off at 64 x 64).

    Examples
    --------
    >>> from ltcl.scenes import box
    >>> scene = glossy(box(3, sides=3), 3, gloss=0.4, projector=(2, 1.4, 1.2), directions=16)
    >>> scene.grid, scene.directions, scene.P.shape
    ((3, 9), 16, (27, 459))
    """
    walls, name, viewer = _room(room, camera)
    blocks, boxes = _blocks(room, blocks)
    n, k = checks.count("n", n), hemisphere.side(directions)
    size, slots = n * n * len(walls), k * k + 1
    needed = 8 * size * slots**2 + 4 * 8 * size**2  # reflectances; form factors and room to work
    checks.fits_host(f"{name}, {size} patches of {slots} x {slots} reflectances,", needed)
    albedos = spread_albedo(albedo, len(walls), n)
    materials = _materials(gloss, exponent, len(walls), k)
    patches = cut(walls, n)
    lights = sight("projector", projector, walls, patches, boxes)
    sees = sight("camera", viewer.eye if camera is None else camera, walls, patches, boxes)
    exchange = beams.exchange(walls, n, directions, rays, boxes, seed)
    form_factors = _form_factors(exchange, patches.area)
    return GlossyScene(
        Scene(name, (n, n * len(walls)), form_factors, albedos, patches.area, walls, viewer, blocks),
        _with_slots(exchange, slots),
        _reflectance(n, materials, lights, sees),
        P=_last_slots((sees.share > 0).astype(np.float64), slots),
        Q=scipy.sparse.csr_array(_last_slots(lights.share, slots).T),
    )


def _room(room: Any, camera: Any) -> tuple[tuple[Wall, ...], str, Viewer]:
    """Walls, name, and who looks: the scene's viewer, or one at the camera who looks at the walls' middle."""
    if isinstance(room, Scene):
        return room.walls, f"glossy {room.name}", room.viewer
    walls = tuple(room) if isinstance(room, Sequence) else ()
    if not walls or not all(isinstance(wall, Wall) for wall in walls):
        raise InputTypeError(f"room is {room!r}; it must be a scene, or one or more walls")
    if camera is None:
        raise InputError("camera is None; it must be a place (x, y, z) where room is walls only")
    viewer = Viewer(point("camera", camera), vector(cut(walls, 1).centre.mean(axis=0)))
    return walls, f"glossy room of {len(walls)} wall(s)", viewer


def _blocks(room: Any, more: Any) -> tuple[tuple[Block, ...], np.ndarray]:
    """All blocks, and their corners (B, 2, 3)."""
    given = tuple(more) if isinstance(more, Sequence) else (more,)
    if not all(isinstance(block, Block) for block in given):
        raise InputTypeError(f"blocks is {more!r}; it must be a sequence of ltcl.scenes.Block")
    every = (*(room.blocks if isinstance(room, Scene) else ()), *given)
    return every, np.array([(block.low, block.high) for block in every]).reshape(-1, 2, 3)


def _materials(gloss: Any, exponent: Any, walls: int, k: int) -> list[tuple[float, brdf.Lobe]]:
    """Share and lobe of each wall."""
    shares, exponents = _per_wall("gloss", gloss, walls), _per_wall("exponent", exponent, walls)
    outside = shares[(shares < 0) | (shares > 1)]
    if len(outside):
        raise InputError(f"gloss has the value {outside[0]:g}; all must be at least 0 and at most 1")
    lobes = {value: brdf.lobe(value, k) for value in exponents.tolist()}
    return [(share, lobes[value]) for share, value in zip(shares.tolist(), exponents.tolist(), strict=True)]


def _per_wall(name: str, value: Any, walls: int) -> np.ndarray:
    """One number for each wall, (walls,), of one for all or one for each."""
    array = checks.finite(name, checks.real(name, value)).astype(np.float64)
    return np.broadcast_to(checks.shape(name, array, (), (walls,)), (walls,))


def _form_factors(exchange: Any, area: np.ndarray) -> np.ndarray:
    """Of matte patches: means over the bins, (N, N); reciprocal, and no row above 1, to rounding."""
    size = len(area)
    bins = exchange.shape[0] // size
    sums = scipy.sparse.kron(scipy.sparse.eye_array(size), np.ones((1, bins)), format="csr")
    both = area[:, None] * (sums @ exchange @ sums.T).toarray() / bins
    form_factors = (both + both.T) / (2 * area[:, None])
    return form_factors / max(1.0, form_factors.sum(axis=1).max())


def _with_slots(exchange: Any, slots: int) -> scipy.sparse.csr_array:
    """The exchange with an empty last slot for each patch: no patch gets what others send to the camera."""
    entries = exchange.tocoo()
    row, column = (index + index // (slots - 1) for index in (entries.row, entries.col))
    size = exchange.shape[0] // (slots - 1) * slots
    return scipy.sparse.csr_array((entries.data, (row, column)), (size, size))


def _last_slots(values: np.ndarray, slots: int) -> scipy.sparse.csr_array:
    """(N, N slots) that picks the last slot of each patch, times a value."""
    rows = np.flatnonzero(values)
    shape = (len(values), len(values) * slots)
    return scipy.sparse.csr_array((values[rows], (rows, (rows + 1) * slots - 1)), shape)


def _reflectance(
    n: int, materials: list[tuple[float, brdf.Lobe]], lights: Sight, sees: Sight
) -> scipy.sparse.bsr_array:
    """K of a white room: a block (M + 1, M + 1) for each patch."""
    bins = len(materials[0][1].scale)
    wall = np.arange(n * n * len(materials)) // n % len(materials)
    blocks = np.zeros((len(wall), bins + 1, bins + 1))
    for number, (share, lobe) in enumerate(materials):
        here = wall == number
        seen, lit = here & (sees.share > 0), here & (lights.share > 0)
        both = seen & lit
        blocks[here, :-1, :-1] = (1 - share + share * lobe.between) / bins
        blocks[seen, -1, :-1] = (1 - share + share * lobe.towards(sees.towards[seen])) / bins
        blocks[lit, :-1, -1] = 1 - share + share * lobe.towards(lights.towards[lit])
        blocks[both, -1, -1] = 1 - share + share * lobe.direct(lights.towards[both], sees.towards[both])
    places = np.arange(len(wall))
    return scipy.sparse.bsr_array((blocks, places, np.arange(len(wall) + 1)))
