# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.compression import cores
from ltcl.operators import Tiles
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


def test_a_budget_is_kept_where_something_fits(device, monkeypatch):
    smallest = cores.best(device, MATRIX, 0.1).nbytes
    assert cores.best(device, MATRIX, 0.1, smallest).nbytes == smallest
    monkeypatch.setenv("LTCL_TUNE", "1")  # the fastest would be larger
    assert cores.best(device, MATRIX, 0.1, smallest - 1).nbytes == smallest
    assert cores.best(device, MATRIX, 0.1, 0.0).nbytes == smallest


@pytest.mark.parametrize(
    ("costs", "best"),
    [
        ([(1.0, 90), (3.0, 10)], 1),  # three times as long, in a ninth of the bytes
        ([(1.0, 90), (12.0, 10)], 0),
        ([(1.0, 90), (10.0, 11)], 1),  # within a quarter
        ([(1.0, 100), (1.26, 99)], 1),
        ([(1.0, 100), (1.27, 99)], 0),
        ([(0.01, 90), (0.04, 50)], 1),  # both as short as a launch
        ([(0.01, 90), (0.4, 50)], 0),
        ([(1.0, 90), (None, 80)], 1),
    ],
)
def test_the_least_time_times_bytes_wins_and_of_those_alike_the_smallest(costs, best):
    launch = 0.1
    assert cores.choose(costs, launch) == best
    assert cores.choose(costs[::-1], launch) == 1 - best


def test_a_launch_takes_time_that_is_looked_at_where_that_is_allowed(device, monkeypatch):
    assert cores.launch(device) == 0.0
    monkeypatch.setenv("LTCL_TUNE", "1")
    assert cores.launch(device) > 0.0


def test_products_are_timed_where_that_is_allowed(device, monkeypatch):
    monkeypatch.setenv("LTCL_TUNE", "1")
    core = cores.best(device, MATRIX, 1e-4)
    assert core.seconds is not None
    assert core.seconds > 0.0
