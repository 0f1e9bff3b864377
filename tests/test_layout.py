# SPDX-License-Identifier: BSD-3-Clause
"""Pictures become right-hand sides and come back in the shape they had."""

from __future__ import annotations

import re

import numpy as np
import pytest

from ltcl.errors import InputError
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


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(
    "shape", [(), (19,), (20, 1), (5, 4), (4, 5, 4), (4, 5, 1), (0, 4, 5), (2, 3, 4, 5), (1, 2, 4, 5, 3)]
)
def test_other_shapes_are_refused(shape, channels):
    with pytest.raises(InputError, match=f"image .*{re.escape(str(shape))}"):
        unpack("image", np.zeros(shape), GRID, channels)


def test_ambiguous_shapes_are_colour():
    """Three frames of 3 x 3 pixels look like one picture of three colours: a colour picture is meant."""
    _, layout = unpack("image", picture((3, 3, 3)), (3, 3), 1)
    assert (layout.frames, layout.colour) == (None, True)
