# SPDX-License-Identifier: BSD-3-Clause
"""Light from a point: inverse squares, cosines, and shadows where geometry says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError, InputTypeError
from ltcl.scenes import box, dihedral
from ltcl.scenes.blocks import Block
from ltcl.scenes.light import irradiance
from ltcl.scenes.walls import Wall

FLOOR = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
N = 20


def places(n: int = N) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the floor's patches, (n, n) each."""
    y, x = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
    return x, y


def test_floor_under_a_lamp_follows_cosine_and_inverse_square() -> None:
    x, y = places()
    lamp = (0.3, 0.6, 0.8)
    expected = 0.8 / ((x - 0.3) ** 2 + (y - 0.6) ** 2 + 0.8**2) ** 1.5
    found = irradiance([FLOOR], (N, N), lamp)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected / expected.max(), rtol=2e-3)


def test_a_block_casts_the_shadow_of_its_outline() -> None:
    """A thin plate at half the lamp's height: its shadow is twice as large, and straight."""
    plate = Block(corner=(0.4, 0.4, 0.5), size=(0.2, 0.2, 1e-6))
    lamp = (0.5, 0.5, 1.0)
    x, y = places()
    open_floor, shaded = irradiance([FLOOR], (N, N), lamp), irradiance([FLOOR], (N, N), lamp, [plate])
    dark = (abs(x - 0.5) < 0.2) & (abs(y - 0.5) < 0.2)
    assert not shaded[dark].any()
    ratio = shaded[~dark] / open_floor[~dark]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)


def test_edges_of_shadows_have_grey_patches() -> None:
    plate = Block(corner=(0.0, 0.0, 0.5), size=(0.33, 1.0, 1e-6))  # the shadow ends at x = 0.16
    shaded = irradiance([FLOOR], (N, N), (0.5, 0.5, 1.0), [plate])
    alone = irradiance([FLOOR], (N, N), (0.5, 0.5, 1.0))
    share = (shaded / alone)[:, 10] / (shaded / alone)[-1, 10]
    assert not share[:3].any()
    assert share[3] == pytest.approx(0.8, abs=1 / 8)
    assert share[4:] == pytest.approx(1, rel=1e-5)


def test_backs_of_walls_are_opaque() -> None:
    """A lamp behind the left wall lights neither it nor, through it, the right one."""
    scene = dihedral(4)
    with pytest.raises(InputError, match=r"light is .* reaches no patch; move it in front of a wall"):
        scene.irradiance(light=(0.5, -0.5, 0.5))
    # Beside the edge it shines past the left wall onto the far end of the right one only.
    screen = Wall("screen", (0.25, 0.5, 1), (0, 0.5, 0), (0, 0, -1))
    found = irradiance([FLOOR, screen], (8, 16), (-0.5, 0.75, 0.5))
    assert not found[:, 8:].any()  # lit from behind
    assert found[1, 6] > 0
    assert not found[3, 6].any()  # in the screen's shadow
    assert found[3, 2] > 0  # beside it


def test_scene_gives_the_picture_of_all_walls() -> None:
    scene = box(6, sides=5)
    found = scene.irradiance((0.5, 0.5, 0.5))
    assert found.shape == scene.grid
    walls = np.split(found, 5, axis=1)
    for wall in walls:  # a lamp in the middle lights all walls alike
        assert wall == pytest.approx(walls[0], rel=1e-5)


@pytest.mark.parametrize(
    ("light", "part"),
    [
        ((0.5, 0.5), r"light is \(0.5, 0.5\); it must be three finite numbers"),
        ((0.5, 0.5, np.inf), "three finite numbers"),
        ("above", "light is 'above'; it must be three numbers"),
        ((0.5, 0.5, -1), "reaches no patch"),
        ((0.45, 0.45, 0.45), "inside a block; move it out"),
    ],
)
def test_bad_lights_are_refused(light: Any, part: str) -> None:
    block = Block(corner=(0.4, 0.4, 0.4), size=(0.1, 0.1, 0.1))
    with pytest.raises((InputError, InputTypeError), match=part):
        irradiance([FLOOR], (2, 2), light, [block])
