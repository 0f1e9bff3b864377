# SPDX-License-Identifier: BSD-3-Clause
"""What projector and camera see of patches: directions, shadows, refusals of places."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes.box import WALLS
from ltcl.scenes.gloss.sight import sight
from ltcl.scenes.patches import cut
from ltcl.scenes.walls import Wall

FLOOR = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))


def test_directions_are_in_the_frame_of_each_patch() -> None:
    patches, point = cut(WALLS, 2), np.array([0.3, 0.6, 0.4])
    seen = sight("camera", point, WALLS, patches)
    assert (seen.share == 1).all()
    back = np.einsum("nij,ni->nj", patches.frames, seen.towards)
    away = point - patches.centre
    assert back == pytest.approx(away / np.linalg.norm(away, axis=1)[:, None])
    assert np.einsum("nij,nkj->nik", patches.frames, patches.frames) == pytest.approx(
        np.broadcast_to(np.eye(3), (24, 3, 3)), abs=1e-12
    )


def test_shadow_of_a_block_falls_where_geometry_says() -> None:
    """A lamp at height 2 over x = 0, a plate at height 1 to x = 0.25: shadow to x = 0.5, half the patches."""
    plate = [[(-1, -1, 1), (0.25, 2, 1.001)]]
    seen = sight("projector", (0, 0.5, 2), [FLOOR], cut([FLOOR], 4), plate)
    assert seen.share.reshape(4, 4).tolist() == [[0] * 4] * 2 + [[1] * 4] * 2
    half = sight("projector", (0, 0.5, 2), [FLOOR], cut([FLOOR], 1), plate)
    assert half.share.tolist() == [0.5]


def test_walls_hide_each_other_from_both_sides() -> None:
    back = Wall("back", corner=(0, 0, 0.5), right=(1, 0, 0), down=(0, 1, 0))  # faces down
    seen = sight("camera", (0.5, 0.5, 2), [FLOOR, FLOOR], cut([FLOOR], 1)).share
    assert seen.tolist() == [1]
    with pytest.raises(InputError, match="camera is at"):
        sight("camera", (0.5, 0.5, 2), [FLOOR, back], cut([FLOOR, back], 1))


@pytest.mark.parametrize(
    ("point", "part"),
    [
        ((0.5, 0.5, 0), "projector is at (0.5, 0.5, 0), on the wall 'floor'; it must stand off it"),
        ((0.5, 0.5, -1), "projector is at (0.5, 0.5, -1), where it faces none of 1 wall(s) in plain view"),
        ((3, 3, 3.5), "projector is at (3, 3, 3.5), in a block; it must stand outside"),
        ((1, 2), "projector is (1, 2); it must be three finite numbers (x, y, z)"),
        ((1, 2, np.nan), "it must be three finite numbers (x, y, z)"),
        ("here", "projector is 'here'; it must be three numbers (x, y, z)"),
    ],
)
def test_bad_places_are_refused_in_one_line(point: Any, part: str) -> None:
    with pytest.raises(ValueError if point != "here" else TypeError) as caught:
        sight("projector", point, [FLOOR], cut([FLOOR], 2), [[(2, 2, 2), (4, 4, 4)]])
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)
