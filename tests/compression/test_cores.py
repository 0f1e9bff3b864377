# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.compression import cores
from ltcl.operators import CSR, Tiles
from tests import gallery

MATRIX = scipy.sparse.csr_array(gallery.sparse(129, 129, 0.1))


def error(core: cores.Core) -> float:
    return float(np.linalg.norm(core.operator.to_dense() - MATRIX.toarray().astype(np.float64), 2))


@pytest.mark.parametrize("allowance", [0.0, 1e-4, 1e-2, 1.0])
def test_the_smallest_core_within_the_error(device, allowance):
    core = cores.best(device, MATRIX, allowance)
    assert error(core) <= allowance
    assert core.quantisation == pytest.approx(
        np.linalg.norm(core.operator.to_dense() - MATRIX.toarray().astype(np.float64)), abs=1e-9
    )
    assert core.seconds is None
    others = [Tiles(device, MATRIX, w, p) for w in (1, 8, 16) for p in ("float32", "float16", "bfloat16")]
    good = [tiles.nbytes for tiles in others if tiles.quantisation <= allowance]
    assert core.nbytes <= min(good)


def test_more_error_never_takes_more_bytes(device):
    sizes = [cores.best(device, MATRIX, allowance).nbytes for allowance in (0.0, 1e-3, 1e-2, 0.1, 1.0)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < sizes[0]


def test_a_budget_is_kept_where_something_fits(device):
    smallest = cores.best(device, MATRIX, 0.1).nbytes
    assert cores.best(device, MATRIX, 0.1, smallest).nbytes == smallest
    assert cores.best(device, MATRIX, 0.1, smallest - 1).nbytes >= smallest


def test_the_fastest_wins_and_of_those_alike_the_smallest(device):
    def core(nbytes: int, seconds: float | None) -> cores.Core:
        return cores.Core(CSR(device, MATRIX), "csr", 1, "float32", nbytes, 0.0, seconds)

    assert cores.choose([core(9, 1.0), core(1, 2.0)]).nbytes == 9
    assert cores.choose([core(9, 1.0), core(1, 1.1)]).nbytes == 1
    assert cores.choose([core(9, 1.0), core(1, None)]).nbytes == 1


def test_products_are_timed_where_that_is_allowed(device, monkeypatch):
    monkeypatch.setenv("LTCL_TUNE", "1")
    core = cores.best(device, MATRIX, 1e-4)
    assert core.seconds is not None
    assert core.seconds > 0.0
