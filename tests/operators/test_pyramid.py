# SPDX-License-Identifier: BSD-3-Clause
"""The quad-tree over the grid."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators import Pyramid, pyramid
from tests import gallery, reference
from tests.operators import helpers

GRIDS = ((1, 1), (1, 2), (3, 5), (1, 29), (29, 1), (8, 8), (7, 12))


@pytest.mark.parametrize("small", [0, 12, 4096])
@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("grid", GRIDS)
def test_products_meet_their_twin(device, monkeypatch, grid, kind, small):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
    monkeypatch.setattr(pyramid, "_SMALL", small)
    monkeypatch.setattr(helpers, "COLUMNS", (None, 1, 3, 5, 11))
    W = Pyramid(device, grid)
    matrix = reference.pyramid_gather(np.eye(W.shape[1]).reshape(*grid, -1))

    def gather(x, scale, add):
        out = scale * reference.pyramid_gather(x.reshape(*grid, -1)).reshape(-1, *x.shape[1:])
        return out if add is None else out + add

    def spread(x, scale, add):
        out = scale * reference.pyramid_spread(x.reshape(len(x), -1), grid).reshape(-1, *x.shape[1:])
        return out if add is None else out + add

    helpers.meets_twin(W, matrix, gather)
    helpers.meets_twin(W, matrix, spread, transpose=True)
    np.testing.assert_array_equal(W.diagonal(), matrix.diagonal())


def test_cells_are_found_by_level_row_and_column(device):
    W = Pyramid(device, (5, 6))
    assert W.cells == ((5, 6), (3, 3), (2, 2), (1, 1))
    assert (W.offsets.tolist(), W.shape, W.orthonormal) == ([0, 30, 39, 43], (44, 30), False)
    spread = W.to_dense().T
    for level, (rows, columns) in enumerate(W.cells):
        for r, c in np.ndindex(rows, columns):
            cell = np.zeros((5, 6))
            cell[r << level : (r + 1) << level, c << level : (c + 1) << level] = 1
            np.testing.assert_array_equal(spread[:, W.index(level, r, c)].reshape(5, 6), cell)


def test_a_picture_takes_four_launches(device):
    W = Pyramid(device, (256, 512))
    x = device.upload(gallery.vectors(256 * 512, 3))
    for apply, launches in ((W.apply, 4), (W.apply_transpose, 1)):
        operand = x if apply == W.apply else W.apply(x)
        with device.profile() as profile:
            apply(operand)
        assert sum(profile.launches.values()) == launches


def test_grids_that_are_none_are_refused(device):
    with pytest.raises(InputError, match=r"grid is \(0, 3\)"):
        Pyramid(device, (0, 3))
