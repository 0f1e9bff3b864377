# SPDX-License-Identifier: BSD-3-Clause
"""The pinhole viewer: projection of known points, culling, filtering, and drawing against reading."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes import trihedral
from ltcl.scenes.viewer import Viewer, draw, frame, read
from ltcl.scenes.walls import Wall

# A unit screen one unit in front of an eye that looks along +y: x to the right, z up.
SCREEN = Wall("screen", corner=(0, 1, 1), right=(1, 0, 0), down=(0, 0, -1))
EYE = Viewer(eye=(0.5, 0, 0.5), target=(0.5, 1, 0.5))


def test_homography_maps_corners_as_a_pinhole_does() -> None:
    for (u, v), expected in {(0, 0): (-0.5, -0.5), (1, 0): (0.5, -0.5), (0, 1): (-0.5, 0.5)}.items():
        x, y, w = EYE.homography(SCREEN) @ (u, v, 1)
        assert (x / w, y / w) == pytest.approx(expected)


def test_farther_things_look_smaller() -> None:
    far = Viewer(eye=(0.5, -3, 0.5), target=(0.5, 1, 0.5))
    assert frame(far, [SCREEN]).size == pytest.approx(frame(EYE, [SCREEN]).size / 4)


def test_walls_show_their_front_only() -> None:
    back = Wall("back", corner=(1, 1, 1), right=(-1, 0, 0), down=(0, 0, -1))
    assert EYE.sees(SCREEN)
    assert not EYE.sees(back)


def test_screen_seen_straight_keeps_its_picture() -> None:
    """Without perspective, one patch a pixel: drawing reproduces the picture inside the margin."""
    picture = np.random.default_rng(0).random((100, 100)).astype(np.float32)
    image = draw(EYE, [SCREEN], picture, size=106, supersample=1)  # 3 % margin on each side
    assert image[3:-3, 3:-3] == pytest.approx(picture, abs=1e-4)
    assert not image[:3].any()
    assert not image[:, -3:].any()


def test_supersampling_smooths_edges_and_averages_detail() -> None:
    fine = np.tile(np.array([[0, 1], [1, 0]], np.float32), (200, 200))
    image = draw(EYE, [SCREEN], fine, size=53, supersample=8)
    assert image[4:-4, 4:-4] == pytest.approx(0.5, abs=0.02)
    assert 0 < image[10, 1] < 0.5  # the screen's edge lies inside this pixel


def test_reading_takes_the_mean_over_each_patch() -> None:
    image = np.zeros((106, 106), np.float32)
    image[3:53, 3:53] = 1  # the top left quarter of the screen
    picture = read(EYE, [SCREEN], image, grid=(2, 2))
    assert picture == pytest.approx(np.array([[1, 0], [0, 0]]), abs=0.02)
    assert float(read(EYE, [SCREEN], image, grid=(1, 1))[0, 0]) == pytest.approx(0.25, abs=0.02)


def test_image_is_centred_and_just_covers_the_frame() -> None:
    """A wide image loses its sides, a tall one top and bottom; neither is stretched."""
    wide = np.broadcast_to(np.linspace(-1, 1, 300, dtype=np.float32), (100, 300))
    picture = read(EYE, [SCREEN], wide, grid=(4, 4))
    inside = 1 / 3 / 1.06  # what of the width the screen takes
    assert picture[0] == pytest.approx(np.array([-0.75, -0.25, 0.25, 0.75]) * inside, abs=0.005)
    assert read(EYE, [SCREEN], wide.T, grid=(4, 4)) == pytest.approx(picture.T, abs=1e-4)


@pytest.mark.parametrize("size", [61, 200, 333])
def test_reading_undoes_drawing_of_smooth_pictures(size: int) -> None:
    """Also seen at an angle and for any rounding of the image's height; negative values pass."""
    oblique = Viewer(eye=(-0.4, -0.9, 0.8), target=(0.5, 1, 0.5))
    y, x = np.mgrid[:16, :16] / 16
    picture = np.stack([np.sin(3 * x) - 0.5, x * y, 1 - y], axis=-1).astype(np.float32)
    seen = read(oblique, [SCREEN], draw(oblique, [SCREEN], picture, size, supersample=4), grid=(16, 16))
    assert seen[1:-1, 1:-1] == pytest.approx(picture[1:-1, 1:-1], abs=0.02)


def test_black_walls_and_no_walls_stay_apart() -> None:
    image = draw(EYE, [SCREEN], np.ones((3, 5), np.float32), size=64, supersample=2)
    assert image.shape == (64, 64)
    assert set(np.unique(image.round(6))) <= {0.0, 0.25, 0.5, 1.0}  # beside, edge, corner, on the wall


@pytest.mark.parametrize(
    "viewer",
    [
        Viewer(eye=(0.5, 2, 0.5), target=(0.5, 1, 0.5)),  # behind the screen
        Viewer(eye=(0.5, 0, 0.5), target=(0.5, -1, 0.5)),  # looks away
    ],
)
def test_viewer_must_see_a_wall_in_front(viewer: Viewer) -> None:
    with pytest.raises(InputError, match=r"viewer at .* must face the viewer"):
        frame(viewer, [SCREEN])


def test_viewer_must_look_sideways() -> None:
    with pytest.raises(InputError, match="straight up or down"):
        Viewer(eye=(1, 1, 3), target=(1, 1, 0))


# Half as high and wide as it, in front of the middle of the screen: they look twice as large from the eye.
CARD = Wall("card", corner=(0.375, 0.5, 0.625), right=(0.25, 0, 0), down=(0, 0, -0.25))


@pytest.mark.parametrize("order", [(SCREEN, CARD), (CARD, SCREEN)])
def test_the_nearest_wall_shows(order: tuple[Wall, Wall]) -> None:
    """Whatever the order of the walls: the card covers half of the screen's width."""
    values = {SCREEN: 1.0, CARD: 5.0}
    picture = np.concatenate([np.full((4, 4), values[wall]) for wall in order], axis=1)
    image = draw(EYE, order, picture, size=106, supersample=2)
    assert image[53, 53] == 5
    assert (image == 5).sum() == pytest.approx(50**2, rel=0.05)
    assert (image == 1).sum() == pytest.approx(100**2 - 50**2, rel=0.05)


def test_screens_show_black_and_hide() -> None:
    image = draw(EYE, [SCREEN], np.ones((4, 4)), size=106, supersample=1, screens=[CARD])
    assert (image[30:76, 30:76] == 0).all()
    assert image[10, 10] == 1


@pytest.mark.parametrize("screen", [True, False])
def test_hidden_patches_read_nothing_and_partly_hidden_ones_what_shows(screen: bool) -> None:
    image = np.zeros((106, 106), np.float32)
    image[:, 53:] = 1
    walls, screens = ([SCREEN], [CARD]) if screen else ([SCREEN, CARD], [])
    picture = read(EYE, walls, image, (8, 8 * len(walls)), screens)
    wall = picture[:, :8]
    assert not wall[2:6, 2:6].any()  # behind the card
    assert wall[:2, 4:] == pytest.approx(1, abs=0.01)
    assert wall[2:6, 6:] == pytest.approx(1)
    if not screen:
        assert picture[:, 12:] == pytest.approx(1, abs=0.01)
    coarse = read(EYE, [SCREEN], image, (2, 2), [CARD])  # a quarter of each patch is hidden
    assert coarse == pytest.approx(np.array([[0, 1], [0, 1]]), abs=0.03)


def test_colours_are_hidden_as_well() -> None:
    picture = read(EYE, [SCREEN], np.ones((50, 50, 3), np.float32), (4, 4), [CARD])
    assert picture.shape == (4, 4, 3)
    assert not picture[1:3, 1:3].any()
    assert picture[0] == pytest.approx(1)


def test_seams_of_slanted_walls_show_no_cracks() -> None:
    """Points on a seam belong to one of its walls, whatever rounding says."""
    scene = trihedral(2, angle=60)
    image = scene.view(np.ones(scene.grid), size=300)
    inside = image[60:240, 100:200]
    assert inside.min() == 1
