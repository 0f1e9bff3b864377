# SPDX-License-Identifier: BSD-3-Clause
"""First hits of rays; the view of walls from a viewer, a projector or a camera."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes import Block, box, cut, trihedral
from ltcl.scenes.builders import WALLS
from ltcl.scenes.camera import SceneCamera, draw, frame, read
from ltcl.scenes.rays import cast, clear, sight
from ltcl.scenes.walls import Wall
from tests import reference

FLOOR = WALLS[2]
# A unit screen one unit in front of an eye that looks along +y: x to the right, z up.
SCREEN = Wall("screen", corner=(0, 1, 1), right=(1, 0, 0), down=(0, 0, -1))
EYE = SceneCamera(eye=(0.5, 0, 0.5), target=(0.5, 1, 0.5))


def test_blocks_stop_rays_as_the_twin_says() -> None:
    block = Block((0.2, 0.3, 0.1), (0.4, 0.3, 0.5))
    rng = np.random.default_rng(1)
    boxes = np.array([(block.low, block.high)])
    start, end = rng.random((2, 3000, 3))
    middle_and_half = np.concatenate([boxes.mean(axis=1), np.array([block.size]) / 2], axis=1)
    twin = reference.blocked(start, end, middle_and_half)
    np.testing.assert_array_equal(clear((), start, end, boxes), ~twin)
    # Its own faces are in front of it; a ray from the face outwards, along it or over the top
    # passes.
    hits = cast(block.faces(), start[twin], (end - start)[twin], boxes)
    outside = ((start < block.low) | (start > block.high)).any(axis=1)[twin]
    assert (hits.wall[outside] >= 0).all()
    places = [(0.6, 0.4, 0.3)] * 2 + [(0, 0, 0.6)]
    aims = [(1, 0.9, 0.9), (0.6, 0.9, 0.3), (1, 1, 0.6)]
    assert clear((), np.array(places, float), np.array(aims), boxes).all()
    assert not clear((), np.array([[0.6, 0.4, 0.3]]), np.array([0.0, 0.4, 0.3]), boxes).any()


def test_sight_is_in_the_frame_of_each_patch_and_keeps_to_shadows() -> None:
    patches = cut(WALLS, 2)
    place = np.array([0.3, 0.6, 0.4])
    seen = sight("camera", place, WALLS, patches)
    assert (seen.share == 1).all()
    away = place - patches.centre
    back = np.einsum("nij,ni->nj", patches.frames, seen.towards)
    assert back == pytest.approx(away / np.linalg.norm(away, axis=1)[:, None])
    # A lamp at height 2 over x = 0, a plate at height 1 to x = 0.25: shadow to x = 0.5, half the
    # patches.
    plate = [[(-1, -1, 1), (0.25, 2, 1.001)]]
    for n, expected in ((4, [0] * 8 + [1] * 8), (1, [0.5])):
        assert (
            sight("projector", (0, 0.5, 2), [FLOOR], cut([FLOOR], n), plate).share.tolist()
            == expected
        )


def test_a_pinhole_shows_a_screen_as_it_is() -> None:
    """Seen straight, one patch a pixel: drawing reproduces the picture inside a margin of 3 %."""
    near, far = (
        frame(eye, [SCREEN]).size for eye in (EYE, SceneCamera((0.5, -3, 0.5), EYE.target))
    )
    assert far == pytest.approx(near / 4)
    picture = np.random.default_rng(0).random((100, 100)).astype(np.float32)
    image = draw(EYE, [SCREEN], picture, size=106, supersample=1)
    assert image[3:-3, 3:-3] == pytest.approx(picture, abs=1e-4)
    assert not np.concatenate([image[:3].ravel(), image[:, -3:].ravel()]).any()
    fine = np.tile(np.array([[0, 1], [1, 0]], np.float32), (200, 200))
    assert draw(EYE, [SCREEN], fine, 53, supersample=8)[4:-4, 4:-4] == pytest.approx(0.5, abs=0.02)
    # Read: its sides are lost.
    wide = np.broadcast_to(np.linspace(-1, 1, 300, dtype=np.float32), (100, 300))
    inside = np.array([-0.75, -0.25, 0.25, 0.75]) / 3 / 1.06
    assert read(EYE, [SCREEN], wide, grid=(4, 4))[0] == pytest.approx(inside, abs=0.005)
    assert read(EYE, [SCREEN], wide.T, grid=(4, 4))[:, 0] == pytest.approx(inside, abs=0.005)


@pytest.mark.parametrize("size", [61, 200])
def test_reading_undoes_drawing_of_smooth_pictures(size: int) -> None:
    """Also seen at an angle and for any rounding of the image's height; negative values pass."""
    oblique = SceneCamera(eye=(-0.4, -0.9, 0.8), target=(0.5, 1, 0.5))
    y, x = np.mgrid[:16, :16] / 16
    picture = np.stack([np.sin(3 * x) - 0.5, x * y, 1 - y], axis=-1).astype(np.float32)
    seen = read(
        oblique, [SCREEN], draw(oblique, [SCREEN], picture, size, supersample=4), grid=(16, 16)
    )
    assert seen[1:-1, 1:-1] == pytest.approx(picture[1:-1, 1:-1], abs=0.02)


def test_a_block_hides_what_is_behind_it_and_seams_show_no_cracks(device) -> None:
    scene = box(
        10, sides=3, occluder=Block((0.3, 0.35, 0), (0.35, 0.3, 0.5), albedo=0.6), device=device
    )
    picture = scene.sample(np.ones((300, 300)))
    floor = picture[:, 20:30]
    top = picture[:, -10:]
    left = picture[:, 40:50]
    assert not floor[4:6, 4:6].any()  # under the block
    assert not left.any()  # its face -x, seen from behind
    assert (floor[9], top) == (pytest.approx(1), pytest.approx(1))
    slanted = trihedral(2, angle=60)
    assert slanted.view(np.ones(slanted.grid), size=300)[60:240, 100:200].min() == 1
