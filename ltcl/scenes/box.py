# SPDX-License-Identifier: BSD-3-Clause
"""A unit cube with one to six walls, seen from its open front: the scenes of figures 4 and 5.

The far upright edge of the room is the z axis. From the viewer, the walls come in this order:

    1 left, 2 right, 3 floor, 4 ceiling, 5 near right (faces left), 6 near left (faces right)

so three make a room corner, five an open box, six a closed one. The first two are the dihedral.
"""

from __future__ import annotations

from typing import Any

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.blocks import Block
from ltcl.scenes.exchange.assembly import assemble
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall

WALLS = (
    Wall("left", corner=(1, 0, 1), right=(-1, 0, 0), down=(0, 0, -1)),
    Wall("right", corner=(0, 0, 1), right=(0, 1, 0), down=(0, 0, -1)),
    Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0)),
    Wall("ceiling", corner=(0, 0, 1), right=(1, 0, 0), down=(0, 1, 0)),
    Wall("near right", corner=(0, 1, 1), right=(1, 0, 0), down=(0, 0, -1)),
    Wall("near left", corner=(1, 1, 1), right=(0, -1, 0), down=(0, 0, -1)),
)
"""Faces of the unit cube from inside, in the order in which `box` adds them."""

_ABOVE = Viewer(eye=(2.6, 2.6, 2.1), target=(0, 0, 0.25))
_LEVEL = Viewer(eye=(2.6, 2.6, 0.5), target=(0, 0, 0.5))


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
        Walls present, 1 to 6: left, right, floor, ceiling, near right, near left. One wall alone
        has no interreflection (A = 0).
    albedo : array_like in [0, 1)
        A scalar; (sides,), one per wall; (3,), one colour; (sides, 3), one colour per wall. With
        three sides, three numbers could mean both and are refused: write (3, 1) or (1, 3).
    occluder : Block, optional
        An opaque block inside the cube, which it may touch. It casts shadows; if it has an albedo, its faces
        are part of the picture, except those that lie in a wall.
    device : Device or str, optional
        What traces rays past the occluder; the best one if omitted. Without an occluder none is opened.

    Returns
    -------
    Scene
        Grid (n, sides * n), walls side by side in the order above, then the faces of the occluder in the
        order of `Block.faces`, n x n patches each. The floor's left edge meets the
        left wall and its top edge the right one; the ceiling's are the other way round.

    Raises
    ------
    InputError
        If n or sides or albedo is out of range, or albedo has another shape, or the occluder reaches out of
        the cube.
    MemoryLimitError
        If form factors and transport would not fit in the memory of the host; nothing is allocated then.

    Notes
    -----
    Figures 4 and 5 of the paper. Exact form factors, see `ltcl.scenes.exchange.cube_tables`; past an
    occluder they are sampled, see `ltcl.scenes.exchange.occlusion`.

    Examples
    --------
    >>> room = box(4, sides=3, albedo=[(0.7, 0.1, 0.1), (0.1, 0.7, 0.1), (0.6, 0.6, 0.6)])
    >>> room.grid, room.channels, [wall.name for wall in room.walls]
    ((4, 12), 3, ['left', 'right', 'floor'])
    >>> table = Block(corner=(0.3, 0.3, 0), size=(0.4, 0.4, 0.3), albedo=0.5)
    >>> box(4, sides=3, occluder=table).grid
    (4, 32)
    """
    if checks.count("sides", sides) > len(WALLS):
        raise InputError(f"sides is {sides}; it must be at most {len(WALLS)}")
    # From above a ceiling would show its back, and walls alone look best at eye level.
    viewer = _ABOVE if sides == 3 else _LEVEL
    if not isinstance(occluder, Block | None):
        raise InputTypeError(f"occluder is {occluder!r}; it must be an ltcl.scenes.Block")
    name = f"box with {sides} side(s)" + (" and a block" if occluder else "")
    return assemble(name, WALLS[:sides], n, albedo, viewer, occluder=occluder, device=device)
