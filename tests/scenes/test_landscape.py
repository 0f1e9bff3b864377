# SPDX-License-Identifier: BSD-3-Clause
"""The picture of the package: colours that ask much of a projector, any shape."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes import landscape


def test_picture_holds_saturated_blue_and_orange_white_and_black() -> None:
    picture = landscape(120, 192)
    r, b = picture[..., 0], picture[..., 2]
    share = {
        "blue": (b > 2 * r) & (b > 0.15),
        "orange": (r > 2 * b) & (r > 0.3),
        "white": picture.min(axis=-1) > 0.5,
        "black": picture.max(axis=-1) < 0.02,
    }
    assert {name: bool(where.mean() > 0.01) for name, where in share.items()} == dict.fromkeys(share, True)
    shrunk = cv2.resize(landscape(640, 1024), (192, 120), interpolation=cv2.INTER_AREA)
    np.testing.assert_allclose(picture, shrunk, atol=0.02)


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (200, 1), (100, 100), (64, 128), (700, 700)])
def test_any_shape_is_in_range(shape: tuple[int, int]) -> None:
    picture = landscape(*shape)
    assert (picture.shape, picture.dtype) == ((*shape, 3), np.float32)
    assert picture.min() >= 0
    assert picture.max() <= 1


def test_other_shapes_are_cut_around_the_sun() -> None:
    whole, left = landscape(640, 1024), round(0.64 * (1024 - 640))
    np.testing.assert_array_equal(landscape(640, 640), whole[:, left : left + 640])
    np.testing.assert_array_equal(landscape(320, 1024), whole[round(0.43 * 320) :][:320])


@pytest.mark.parametrize(
    ("h", "w", "part"), [(0, 4, "h is 0"), (4, 2.5, "w is 2.5"), (40000, 4, "h is 40000")]
)
def test_bad_sizes_are_refused(h: Any, w: Any, part: str) -> None:
    with pytest.raises(InputError, match=part):
        landscape(h, w)
