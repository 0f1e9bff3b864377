# SPDX-License-Identifier: BSD-3-Clause
"""The quad-tree over the grid."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators import Pyramid
from tests import gallery, reference
from tests.operators import helpers

GRIDS = ((1, 1), (1, 2), (3, 5), (1, 29), (29, 1), (8, 8), (7, 12))


@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("grid", GRIDS)
def test_products_meet_their_twin(device, monkeypatch, grid, kind):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
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
    assert W.offsets.tolist() == [0, 30, 39, 43]
    assert W.shape == (44, 30)
    assert not W.orthonormal
    places = gallery.signed(44, 1)[:, 0] > 2  # none
    for level, (rows, columns) in enumerate(W.cells):
        row, column = np.indices((rows, columns))
        index = W.index(level, row, column)
        assert not places[index].any()
        places[index] = True
        for r, c in np.ndindex(rows, columns):
            cell = np.zeros((5, 6))
            cell[r << level : (r + 1) << level, c << level : (c + 1) << level] = 1
            unit = np.zeros(44)
            unit[W.index(level, r, c)] = 1
            np.testing.assert_array_equal((W.T @ unit).reshape(5, 6), cell)
    assert places.all()


def test_grids_that_are_none_are_refused(device):
    with pytest.raises(InputError, match=r"grid is \(0, 3\).* must be"):
        Pyramid(device, (0, 3))
