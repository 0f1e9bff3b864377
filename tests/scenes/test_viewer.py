# SPDX-License-Identifier: BSD-3-Clause
"""The pinhole viewer: projection of known points, culling, filtering, and drawing against reading."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError
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
