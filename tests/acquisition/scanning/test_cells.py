# SPDX-License-Identifier: BSD-3-Clause
"""Blocks, cells of the quad-tree and their colours, against sums and conflicts written out."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.scanning.cells import Blocks, Cells, colour
from ltcl.errors import InputError
from ltcl.operators import Pyramid
from tests import reference

GRIDS = [(1, 1), (1, 7), (5, 1), (5, 6), (8, 8), (3, 17)]


@pytest.mark.parametrize("grid", GRIDS)
def test_cells_are_those_of_the_pyramid(device, grid):
    cells, W = Cells(grid), Pyramid(device, grid)
    assert (cells.sizes, cells.offsets[-1]) == (W.cells, W.shape[0])
    x = np.random.default_rng(0).random(grid)
    np.testing.assert_allclose(cells.sums(x.ravel()), reference.pyramid_gather(x[..., None])[:, 0])


@pytest.mark.parametrize("grid", GRIDS)
def test_children_make_up_their_parent(grid):
    cells = Cells(grid)
    for level in range(1, cells.top + 1):
        rows, columns = cells.sizes[level]
        numbers = np.arange(rows * columns)
        kids = cells.children(level, numbers)
        for number in numbers:
            own = kids[:, number]
            together = cells.pattern(level - 1, own[own >= 0])
            np.testing.assert_array_equal(together, cells.pattern(level, numbers[number : number + 1]))
            assert cells.areas(level)[number] == together.sum()
        lit = cells.pattern(level, numbers[::2]).ravel() > 0
        np.testing.assert_array_equal(lit, (cells.of_pixels(level) - cells.offsets[level]) % 2 == 0)


@pytest.mark.parametrize(("pixels", "side"), [((5, 7), 2), ((5, 7), 3), ((4, 4), 1), ((2, 9), 9)])
def test_blocks(pixels, side):
    blocks, rng = Blocks(pixels, side), np.random.default_rng(1)
    x, picture = rng.random(blocks.grid), rng.random(pixels)
    big = blocks.enlarged(x)
    assert big.shape == pixels
    for r, c in np.ndindex(pixels):
        assert big[r, c] == x[r // side, c // side]
    for r, c in np.ndindex(blocks.grid):
        part = picture[r * side : (r + 1) * side, c * side : (c + 1) * side]
        assert blocks.sum(picture)[r, c] == pytest.approx(part.sum())
    with pytest.raises(InputError, match="block is"):
        Blocks(pixels, 0)


@pytest.mark.parametrize("seed", range(4))
def test_cells_of_one_colour_do_not_conflict(seed):
    rng = np.random.default_rng(seed)
    cells, pixels = 40, 60
    active = rng.random((cells, pixels)) < 0.08 * (1 + seed)
    active[:2, 0] = True
    starts = np.concatenate([[0], np.cumsum(active.sum(axis=1))])
    found = colour(starts, np.nonzero(active)[1], pixels)
    for number in range(found.max() + 1):
        assert active[found == number].sum(axis=0).max() <= 1
    conflicts = (active.astype(int) @ active.T > 0).sum(axis=1) - 1
    assert active.sum(axis=0).max() <= found.max() + 1 <= conflicts.max() + 1  # greedy is no worse
