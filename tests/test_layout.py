# SPDX-License-Identifier: BSD-3-Clause
"""Pictures become right-hand sides and come back in the shape they had."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError, InputTypeError
from ltcl.layout import unpack

GRID = (4, 5)
N = 20
# Shape of the picture, channels of the transport, shape of each column block, shape of the result.
CASES = {
    "grey": ((4, 5), 1, (20, 1), (4, 5)),
    "flat": ((20,), 1, (20, 1), (20,)),
    "colour": ((4, 5, 3), 1, (20, 3), (4, 5, 3)),
    "frames": ((6, 4, 5), 1, (20, 6), (6, 4, 5)),
    "one frame": ((1, 4, 5), 1, (20, 1), (1, 4, 5)),
    "colour frames": ((6, 4, 5, 3), 1, (20, 18), (6, 4, 5, 3)),
    "grey, colour transport": ((4, 5), 3, (20, 1), (4, 5, 3)),
    "flat, colour transport": ((20,), 3, (20, 1), (20, 3)),
    "colour, colour transport": ((4, 5, 3), 3, (20, 1), (4, 5, 3)),
    "frames, colour transport": ((6, 4, 5), 3, (20, 6), (6, 4, 5, 3)),
    "colour frames, colour transport": ((6, 4, 5, 3), 3, (20, 6), (6, 4, 5, 3)),
}


def picture(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape)


@pytest.mark.parametrize("name", CASES)
def test_pictures_come_back(name):
    shape, channels, block, result = CASES[name]
    values = picture(shape)
    columns, layout = unpack("image", values, GRID, channels)
    assert [column.shape for column in columns] == [block] * channels
    assert all(column.flags.c_contiguous for column in columns)
    packed = layout.pack(columns, GRID)
    assert packed.shape == result
    grey = len(result) > len(shape)
    np.testing.assert_array_equal(packed, np.broadcast_to(values[..., None], result) if grey else values)


def test_columns_are_frames_and_within_them_colours():
    values = picture((2, *GRID, 3))
    (columns,), _ = unpack("image", values, GRID, 1)
    for frame in range(2):
        for colour in range(3):
            np.testing.assert_array_equal(columns[:, 3 * frame + colour], values[frame, :, :, colour].ravel())
    blocks, _ = unpack("image", values, GRID, 3)
    for colour, block in enumerate(blocks):
        np.testing.assert_array_equal(block, values[..., colour].reshape(2, N).T)


def test_a_camera_may_have_another_grid():
    columns, layout = unpack("pattern", picture((2, *GRID, 3)), GRID, 3)
    seen = [column[:6] for column in columns]  # a transport to 2 x 3 camera pixels
    assert layout.pack(seen, (2, 3)).shape == (2, 2, 3, 3)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(
    "shape", [(), (19,), (20, 1), (5, 4), (4, 5, 4), (4, 5, 1), (0, 4, 5), (2, 3, 4, 5), (1, 2, 4, 5, 3)]
)
def test_other_shapes_are_refused_with_those_that_fit(shape, channels):
    with pytest.raises(
        InputError, match=r"image has shape \(.*\); it must be \(4, 5\), \(4, 5, 3\) or frames"
    ):
        unpack("image", np.zeros(shape), GRID, channels)


def test_unusable_numbers_are_refused():
    with pytest.raises(InputError, match=r"image has 1 NaN or infinite value\(s\), the first at \(0, 2\)"):
        unpack("image", np.where(np.arange(N).reshape(GRID) == 2, np.nan, 0), GRID, 1)
    with pytest.raises(InputTypeError, match="image holds"):
        unpack("image", np.full(GRID, "a"), GRID, 1)


def test_ambiguous_shapes_are_colour():
    """Three frames of 3 x 3 pixels look like one picture of three colours: a colour picture is meant."""
    _, layout = unpack("image", picture((3, 3, 3)), (3, 3), 1)
    assert (layout.frames, layout.colour) == (None, True)
