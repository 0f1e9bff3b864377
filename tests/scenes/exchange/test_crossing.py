# SPDX-License-Identifier: BSD-3-Clause
"""Walls may touch, but not cut through each other or cover each other."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ltcl.errors import InputError
from ltcl.scenes import dihedral
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange.crossing import refuse
from ltcl.scenes.walls import Wall

FLOOR = WALLS[2]


def test_touching_walls_pass() -> None:
    refuse(WALLS)
    refuse([FLOOR, Wall("middle", (0.5, 0.2, 1), (0, 0.5, 0), (0, 0, -1))])  # stands on the floor
    refuse([FLOOR, Wall("beside", (1.5, 0.2, 1), (0, 0.5, 0), (0, 0, -3))])  # cuts the plane, not the floor
    refuse([FLOOR, Wall("back", (0, 0, 0), (1, 0, 0), (0, 1, 0))])  # a floor with two sides
    refuse([FLOOR, Wall("next", (1, 0, 0), (0, 1, 0), (1, 0, 0))])
    refuse([FLOOR, Wall("corner to corner", (0.5, 1, 0.5), (0.5, 0.5, 0), (0, 0, -1))])


@pytest.mark.parametrize(
    ("wall", "what"),
    [
        (Wall("other", (0.5, 0.2, 1), (0, 0.5, 0), (0, 0, -1.01)), "cut through each other"),
        (Wall("other", (0.5, 0.9, 0.1), (0, 0.5, 0), (0.1, 0, -1)), "cut through each other"),
        (Wall("other", (-1, 0.5, -1), (3, 0.1, 3), (0, 0, -0.7)), "cut through each other"),
        (Wall("other", (0.9, 0.9, 0), (0, 1, 0), (1, 0, 0)), "lie on top of each other"),
        (Wall("other", (0.2, 0.2, 0), (0, 0.1, 0), (0.1, 0, 0)), "lie on top of each other"),
    ],
)
def test_others_are_refused(wall: Wall, what: str) -> None:
    for pair in ([FLOOR, wall], [wall, FLOOR]):
        with pytest.raises(InputError, match=f"'floor'.* {what}|'other'.* {what}"):
            refuse(pair)


def test_scenes_of_crossing_walls_are_refused() -> None:
    scene = dihedral(2)
    through = Wall("through", (0.5, -0.5, 0.7), (0, 1, 0), (0, 0, -0.4))
    with pytest.raises(InputError, match=r"walls 'left' and 'through' cut through .* move or shorten one"):
        replace(scene, walls=(scene.walls[0], through))
