# SPDX-License-Identifier: BSD-3-Clause
"""The picture of the package: colours that ask much of a projector, any shape."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes import landscape


def test_picture_has_saturated_blue_and_orange_white_and_black() -> None:
    picture = landscape(120, 192)
    r, b = picture[..., 0], picture[..., 2]
    shares = [
        (b > 2 * r) & (b > 0.15),
        (r > 2 * b) & (r > 0.3),
        picture.min(-1) > 0.5,
        picture.max(-1) < 0.02,
    ]
    assert min(share.mean() for share in shares) > 0.01


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (200, 1), (640, 640), (320, 1024)])
def test_other_shapes_are_cut_around_the_sun(shape: tuple[int, int]) -> None:
    picture, whole = landscape(*shape), landscape(640, 1024)
    assert (picture.shape, picture.dtype) == ((*shape, 3), np.float32)
    assert 0 <= picture.min() <= picture.max() <= 1
    if shape == (640, 640):  # 0.64 of the rest is to the left
        np.testing.assert_array_equal(picture, whole[:, 246 : 246 + 640])
