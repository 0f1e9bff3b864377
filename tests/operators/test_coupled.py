# SPDX-License-Identifier: BSD-3-Clause
"""Channels as one operator, against the explicit matrix of all blocks."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.operators import Coupled, Dense
from tests import gallery, reference
from tests.operators.helpers import close

M = np.array([[1.0, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.1]])


def explicit(blocks: list[list[np.ndarray]], mixing: np.ndarray) -> np.ndarray:
    """The whole matrix in float64."""
    columns = blocks[0][0].shape[1]
    return np.block(blocks).astype(np.float64) @ np.kron(mixing, np.eye(columns))


@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (53, 7), (7, 53)])
@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("k", [None, 1, 5])
def test_products_are_those_of_the_explicit_matrix(device, shape, mixed, full, k):
    blocks = [[gallery.signed(*shape, seed=3 * c + j) * (full or c == j) for j in range(3)] for c in range(3)]
    mixing = M if mixed else np.eye(3)
    operators = [
        [Dense(device, b) if full or c == j else None for j, b in enumerate(row)]
        for c, row in enumerate(blocks)
    ]
    A = Coupled(operators, mixing if mixed else None)
    if not full:
        A = Coupled.mixed([Dense(device, row[c]) for c, row in enumerate(blocks)], mixing)
    whole = explicit(blocks, mixing)
    for matrix, apply in ((whole, A.apply), (whole.T, A.apply_transpose)):
        x, add = gallery.vectors(matrix.shape[1], k), gallery.vectors(matrix.shape[0], k, 2)
        X, add_there = device.upload(x), device.upload(add)
        error = 10 * reference.product_error(np.abs(matrix) + 1, np.abs(x))
        close(apply(X).get(), matrix @ x, error)
        close(
            apply(X, scale=-2.0, add=add_there).get(), -2 * (matrix @ x) + add, 2 * error + np.abs(add) * 1e-6
        )
        apply(X, add_there, add=add_there)
        close(add_there.get(), matrix @ x + add, error + np.abs(add) * 1e-6)


def test_diagonal_and_size(device):
    blocks = [[gallery.signed(6, 6, 3 * c + j) for j in range(3)] for c in range(3)]
    A = Coupled([[Dense(device, block) for block in row] for row in blocks], M)
    np.testing.assert_allclose(A.diagonal(), np.diagonal(explicit(blocks, M)), rtol=1e-6)
    assert A.nbytes == 9 * Dense(device, blocks[0][0]).nbytes
    wide = Dense(device, gallery.signed(2, 3))
    with pytest.raises(InputError, match="not square; it has no diagonal"):
        Coupled([[wide] * 3] * 3).diagonal()


def test_blocks_that_do_not_fit_are_refused(device):
    a, b = Dense(device, gallery.signed(3, 3)), Dense(device, gallery.signed(3, 2))
    for blocks in ([[a] * 3] * 2, [[a] * 2] * 3, [[a, a, b], [a] * 3, [a] * 3], [[None] * 3] * 3):
        with pytest.raises(InputError, match="blocks must be 3 x 3 operators of one shape, or None"):
            Coupled(blocks)
