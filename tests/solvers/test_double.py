# SPDX-License-Identifier: BSD-3-Clause
"""Products in float64 on the host, against matrices in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl import checks
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    Host,
    IdentityPlus,
    RowBlocks,
    ScaledColumns,
    Shifted,
    Tiles,
)
from ltcl.solvers.double import product
from tests.problems import enclosure

N = 43
A = enclosure(N, 0.6).R
SINGLE = A.astype(np.float32).astype(np.float64)
D = np.random.default_rng(0).uniform(0.5, 1.5, N)
KINDS = {
    "dense": (lambda device: Dense(device, A), SINGLE),
    "csr": (lambda device: CSR(device, scipy.sparse.csr_array(A)), SINGLE),
    "tiles": (lambda device: Tiles(device, scipy.sparse.csr_array(A), 8, "float32"), SINGLE),
    "host": (lambda device: Host(device, A), A),
    "I + R": (lambda device: IdentityPlus(Dense(device, A)), np.eye(N) + SINGLE),
    "I - R": (lambda device: IdentityPlus(Dense(device, A), -1), np.eye(N) - SINGLE),
    "S of an operator": (
        lambda device: IdentityPlus(Shifted(ScaledColumns(Host(device, A), D))),
        np.eye(N) + A * D - np.eye(N),
    ),
    "masked": (
        lambda device: Shifted(Host(device, A), np.arange(N) % 2),
        A - np.diag(np.arange(N) % 2),
    ),
}


@pytest.mark.parametrize("columns", [1, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_products_are_those_of_float64(device, kind, columns):
    make, dense = KINDS[kind]
    times, x = product(make(device)), np.random.default_rng(1).normal(size=(N, columns))
    assert times is not None
    found = times(x)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, dense @ x, rtol=0, atol=1e-13)


def test_one_pixel(device):
    times = product(IdentityPlus(Dense(device, [[0.5]])))
    assert times is not None
    np.testing.assert_allclose(times(np.array([[1e-9]])), [[1.5e-9]], rtol=1e-15)


def test_what_is_on_the_device_alone_has_none(device, monkeypatch):
    sparse = scipy.sparse.csr_array(A)
    blocks = RowBlocks(device, (N, N), lambda: iter([(0, sparse)]), sparse.nnz)
    for R in (Compressed(Dense(device, A), None, None), blocks):
        assert product(R) is None
        assert product(IdentityPlus(R)) is None
        assert product(ScaledColumns(R, D)) is None
    monkeypatch.setattr(checks, "host_memory", lambda: 15 * N * N)
    assert product(Dense(device, A)) is None
