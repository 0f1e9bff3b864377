# SPDX-License-Identifier: BSD-3-Clause
"""Form factors of a room with an opaque block in it.

    F_ij = V_ij F'_ij      F' of the empty room, exact; V the share of rays between i and j that pass

Rays are traced on the device, by `visibility`: it needs no dependency, never stores a ray, and
also serves the product whose matrix is never stored. Ray libraries are made for the nearest hit of one
ray on millions of triangles; here are N^2 bundles of rays and one box.

Only pairs of room patches need rays. Between a face of the block and the room F' is already exact: of the
room that face sees what is in front of its plane, and as the block is convex, nothing of it is in between.

V is found with 256 rays a pair. In closed rooms rows sum to 1 within 0.5 % from 8 patches along a wall on,
1 % at 4. Where a row came to more, its entries are scaled down, each by the smaller factor of its two
patches: no row makes light, and reciprocity stays exact. Rows below 1 stay as they are. Patches under a
block that stands on them are dark: no light reaches or leaves them, but what a projector throws there.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.scenes import walls as cube
from ltcl.scenes.blocks import Block
from ltcl.scenes.exchange import oblique
from ltcl.scenes.exchange.visibility import visibility
from ltcl.scenes.patches import cut
from ltcl.scenes.walls import Wall, vector

_SAMPLES = 16  # along a side: 256 rays


_TOUCH = 1e-9  # what reaches out of the cube by less is rounding


def lit_faces(block: Block) -> tuple[Wall, ...]:
    """Faces of a block in the unit cube that light can meet: none if it is black, none on the cube's faces.

    Raises
    ------
    InputError
        If the block reaches out of the cube or fills it.

    Examples
    --------
    >>> faces = lit_faces(Block(corner=(0.3, 0.4, 0), size=(0.2, 0.2, 0.5), albedo=0.6))
    >>> len(faces), faces[-1].name  # it stands on the floor
    (5, 'block top')
    """
    low, high = block.low, block.high
    if low.min() < -_TOUCH or high.max() > 1 + _TOUCH:
        raise InputError(
            f"occluder reaches from {vector(low)} to {vector(high)}, out of the room; "
            "it must stay within (0, 0, 0) and (1, 1, 1)"
        )
    if low.max() < _TOUCH and high.min() > 1 - _TOUCH:
        raise InputError("occluder fills the room; it must leave some of it free")
    if block.albedo is None:
        return ()
    return tuple(face for face in block.faces() if not _on_the_cube(face))


def form_factors(
    walls: Sequence[Wall], faces: Sequence[Wall], block: Block, n: int, device: Device | str | None = None
) -> np.ndarray:
    """Form factors of all patches of a room and of a block in it, (N, N) float64, walls before faces.

    Parameters
    ----------
    walls : sequence of Wall
        Faces of the unit cube, seen from inside.
    faces : sequence of Wall
        Those of the block, see `lit_faces`.
    block : Block
    n : int
        Patches along each side of a wall, and of a face.
    device : Device or str, optional
        What traces the rays.

    Raises
    ------
    MemoryLimitError
        If the matrix does not fit in the memory of the host.

    Examples
    --------
    >>> from ltcl.scenes.box import WALLS
    >>> block = Block(corner=(0.25, 0.25, 0), size=(0.5, 0.5, 0.5), albedo=0.5)
    >>> F = form_factors(WALLS, lit_faces(block), block, 4)
    >>> F.shape, bool(F.sum(axis=1).max() <= 1 + 1e-9)
    ((176, 176), True)
    """
    both, room = (*walls, *faces), len(walls)
    checks.fits_host(f"form factors of {n * n * len(both)} patches", 3 * 8 * (n * n * len(both)) ** 2)
    open_way = visibility(cut(walls, n), [(block.low, block.high)], device, samples=_SAMPLES)
    matrix = np.zeros((n, len(both), n, n, len(both), n))
    shape = (n, room, n, n, room, n)
    matrix[:, :room, :, :, :room] = cube.form_factors(walls, n).reshape(shape) * open_way.reshape(shape)
    for i, j in itertools.product(range(room), range(room, len(both))):
        oblique.fill(matrix, both, n, i, j)
    matrix = matrix.reshape(n * n * len(both), -1)
    _make_no_light(matrix)
    return matrix


def _on_the_cube(face: Wall) -> bool:
    """Whether a face lies in a face of the unit cube, looking out of it."""
    along = np.abs(face.normal) > 0.5
    place = np.asarray(face.corner)[along]
    return bool(np.abs(place - (face.normal[along] > 0)).max() < _TOUCH)


def _make_no_light(matrix: np.ndarray) -> None:
    """Scale entries down, in place and symmetrically, until no row sums to more than 1."""
    scale = 1 / np.maximum(matrix.sum(axis=1), 1)
    for row, factor in zip(matrix, scale, strict=True):
        row *= np.minimum(scale, factor)
