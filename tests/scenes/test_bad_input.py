# SPDX-License-Identifier: BSD-3-Clause
"""Bad input to scenes: a line that names argument and value, before anything is computed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError, InputTypeError
from ltcl.scenes import (
    Block,
    FormFactor,
    RefinedScene,
    box,
    cut,
    dihedral,
    glossy,
    refine,
    trihedral,
    visibility,
)
from ltcl.scenes.builders import WALLS
from ltcl.scenes.camera import SceneCamera, frame
from ltcl.scenes.scene import transport_matrix
from ltcl.scenes.walls import Wall, refuse_crossing

FLOOR = WALLS[2]
SCREEN = Wall("screen", corner=(0, 1, 1), right=(1, 0, 0), down=(0, 0, -1))
CORNER = box(5, sides=3)
SHADED = replace(dihedral(2), blocks=(Block(corner=(0.4, 0.4, 0.4), size=(0.1, 0.1, 0.1)),))
PATCHES = cut(WALLS, 1)
BLOCK = [[(0.25, 0.25, 0.0), (0.75, 0.5, 0.5)]]
UNEVEN = np.zeros((75, 75))
UNEVEN[74, 0] = 0.1
ONE = np.array([[0.0, 1.0 + 5e-7], [1.0 + 5e-7, 0.0]])  # as far above 1 as a scene lets pass


def shine(**changes: Any) -> Any:
    place: dict[str, Any] = {
        "projector": (1.5, 0.9, 0.8),
        "camera": (0.8, 1.6, 0.4),
        "directions": 16,
    }
    return glossy(**{"room": dihedral(2), "n": 2, **place, **changes})


BAD: list[Any] = [0, 180, "90", np.nan, [60]]  # angles
CASES: list[tuple[Callable[[], Any], str]] = [
    (lambda: trihedral(2, albedo=1.0), r"outside \[0, 1\)"),
    *((lambda angle=angle: dihedral(2, angle=angle), "angle is .* 180") for angle in BAD[:4]),
    *((lambda angle=angle: trihedral(2, angle=angle), "angle is .* 120") for angle in BAD[3:]),
    (lambda: box(2, sides=7), "sides is 7"),
    (lambda: box(2, sides=3, albedo=[0.1, 0.2, 0.3]), "one per wall"),
    (lambda: box(2, occluder=Block((0.8, 0, 0), (0.3, 0.1, 0.1))), "reaches from .* out of"),
    (lambda: box(2, occluder=Block((0, 0, 0), (1, 1, 1))), "occluder fills the room"),
    (lambda: box(2, occluder=(0.1, 0.1)), "occluder is .*ltcl.scenes.Block"),  # pyright: ignore[reportArgumentType]
    (lambda: transport_matrix(ONE, np.full(2, 1 - 1e-9), np.ones(2)), "gain of 1 or more"),
    (
        lambda: replace(CORNER, grid=(4, 15)),
        r"form_factors has shape \(75, 75\).*\(60, 60\)",
    ),
    (lambda: replace(CORNER, albedo=np.full((1, 75), np.nan)), "albedo has 75 NaN"),
    (lambda: replace(CORNER, form_factors=UNEVEN), "breaks reciprocity by"),
    (lambda: CORNER.sample(np.full((2, 2), np.nan)), "image has 4 NaN"),
    (lambda: SHADED.irradiance((0.5, 0.5)), r"light is \(0.5, 0.5\)"),
    (lambda: SHADED.irradiance((0.5, -0.5, 0.5)), "reaches no patch"),  # behind the left wall
    (lambda: SHADED.irradiance((0.45, 0.45, 0.45)), "inside a block"),
    (lambda: frame(SceneCamera((1, 1, 3), (1, 1, 0)), [SCREEN]), "straight up or down"),
    (lambda: Wall("flat", (0, 0, 0), (1, 0, 0), (2, 0, 0)), "wall 'flat' .* no area"),
    (lambda: Block((0, 0, 0), (0.1, 0, 0.1)), r"block size is \(0.1, 0.0, 0.1\)"),
    (lambda: shine(gloss=-0.1), "gloss is -0.1"),
    (lambda: shine(directions=60), "directions is 60"),
    (lambda: shine(projector=(0, 0.5, 0.5)), "projector is at .*, on the wall 'right'"),
    (lambda: shine(camera=(-1, -1, 0.5)), "camera is at .* 2 wall"),
    (lambda: shine(blocks=[[(0, 0, 0), (1, 1, 1)]]), "blocks is .* ltcl.scenes.Block"),
    (lambda: FormFactor([1], 0.5), "patches is a list"),  # pyright: ignore[reportArgumentType]
    (lambda: FormFactor(PATCHES, [0.5, 0.5]), r"albedo has shape \(2,\)"),
    (lambda: FormFactor.of(replace(dihedral(2), grid=(1, 8))), r"scene .* 1 x 4 .*n x n"),
    (lambda: refine(CORNER, 0), "detail is 0"),
    (lambda: refine(CORNER, 2.5), "detail is 2.5"),  # pyright: ignore[reportArgumentType]
    (lambda: RefinedScene(PATCHES, 2), "patches is a Patches.*Scene"),  # pyright: ignore[reportArgumentType]
    (lambda: refine(shine(), 2), "patches is .*without gloss"),
    (lambda: refine(CORNER, 2).sample(np.full((2, 2), np.nan)), "image has 4 NaN"),
    (lambda: refine(CORNER, 2).view(np.ones((5, 15))), r"picture has shape \(5, 15\)"),
    (lambda: visibility(PATCHES, [[(0, 0, 0), (1, 1, -1)]]), "the first must be below"),
]


@pytest.mark.parametrize(("make", "part"), CASES)
def test_bad_input_is_refused(device: Any, make: Callable[[], Any], part: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=part):
        make()


@pytest.mark.parametrize(
    ("wall", "what"),
    [
        (Wall("other", (0.5, 0.2, 1), (0, 0.5, 0), (0, 0, -1.01)), "cut through"),
        (Wall("other", (-1, 0.5, -1), (3, 0.1, 3), (0, 0, -0.7)), "cut through"),
        (Wall("other", (0.9, 0.9, 0), (0, 1, 0), (1, 0, 0)), "on top of"),
        (Wall("other", (0.2, 0.2, 0), (0, 0.1, 0), (0.1, 0, 0)), "on top of"),
    ],
)
def test_crossing_walls_are_refused(wall: Wall, what: str) -> None:
    for pair in ([FLOOR, wall], [wall, FLOOR]):
        with pytest.raises(InputError, match=f"'floor'.* {what}|'other'.* {what}"):
            refuse_crossing(pair)
