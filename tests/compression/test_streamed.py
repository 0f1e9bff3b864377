# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.compression.sources import source
from ltcl.compression.streamed import Streamed
from tests import gallery
from tests.operators.helpers import meets_twin


@pytest.mark.parametrize("shape", [(1, 1), (53, 7), (7, 53), (65, 129)])
@pytest.mark.parametrize("transpose", [False, True])
def test_products_are_those_of_the_matrix(device, shape, transpose):
    matrix = gallery.signed(*shape)
    A = Streamed(device, source("A", matrix), memory=32 * shape[1] * 16)
    meets_twin(A, matrix, transpose=transpose)


def test_the_diagonal_is_not_rounded(device):
    matrix = np.random.default_rng(1).random((20, 33))
    np.testing.assert_array_equal(Streamed(device, source("A", matrix)).diagonal(), np.diagonal(matrix))
