# SPDX-License-Identifier: BSD-3-Clause
"""Inverses of triangles are joined as NumPy joins them, and as far as launches are worth bytes."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import ltcl
from ltcl.device import Device, tuning
from ltcl.operators import IdentityPlus, relaxation, triangles
from tests import gallery, reference
from tests.conftest import SMALL, launched_as
from tests.operators import helpers

SIZE = 4
# Fewer rows than one triangle, one more, half a pair more, and many.
ROWS = (3, 5, 8, 13, 97)


@pytest.fixture(scope="module")
def gpu(device) -> Device:
    """A device whose kernels are launched as on a GPU."""
    return launched_as(device, "gpu")


def triangle(n: int) -> np.ndarray:
    """A lower triangle with empty rows."""
    entries = np.tril(gallery.signed(n, n, 3), -1) / 5
    entries[np.arange(n) % 3 == 1] = 0
    return (entries + np.diag(np.linspace(1, 2, n))).astype(np.float32)


def inverses_of(P: np.ndarray, size: int) -> np.ndarray:
    """Inverses of the triangles of P below each other, (N, size)."""
    inverses = np.zeros((len(P), size))
    for start in range(0, len(P), size):
        block = slice(start, start + size)
        inverse = scipy.linalg.inv(P[block, block].astype(np.float64))
        inverses[block, : len(inverse)] = inverse
    return inverses


@pytest.mark.parametrize("limit", [None, SMALL], ids=["whole", "slabs"])
@pytest.mark.parametrize("n", ROWS)
@pytest.mark.parametrize("form", helpers.ROWS)
def test_joined_inverses_are_those_of_the_whole_triangle(gpu, form, n, limit):
    gpu.max_allocation = limit or gpu.description.max_allocation
    P = triangle(n)
    M = helpers.FORMATS[form](gpu, P / 2)
    is_cut = n == 97 and limit is not None
    assert (len(M.slabs) > 1) == is_cut
    # Inverses are in one buffer.
    gpu.max_allocation = gpu.description.max_allocation
    first = gpu.upload(inverses_of(P, SIZE))
    entries = [relaxation.entry_arguments(slab, first) for slab in M.slabs]
    for block in (SIZE, 2 * SIZE, 8 * SIZE):
        joined = triangles.join(first, block, M.slabs, entries, 2.0, is_dense=form == "dense")
        np.testing.assert_allclose(joined.get(), inverses_of(P, block), rtol=0, atol=1e-5)


def test_a_pair_is_joined_as_by_its_twins():
    P = triangle(11).astype(np.float64)
    A_inverse = np.linalg.inv(P[:8, :8])
    C_inverse = np.linalg.inv(P[8:, 8:])
    T = reference.triangle_products(P[8:, :8], A_inverse)
    joined = reference.triangle_join(A_inverse, C_inverse, T)
    np.testing.assert_allclose(joined, np.linalg.inv(P), rtol=0, atol=1e-12)


@pytest.mark.parametrize("form", helpers.ROWS)
def test_sweeps_by_joined_inverses_are_those_row_after_row(gpu, monkeypatch, form):
    monkeypatch.setattr(relaxation, "DEFAULT_BLOCK_ROWS", 8)
    gpu.max_allocation = gpu.description.max_allocation
    R = gallery.sparse(97, 97, 0.3).toarray() / 20
    relax = relaxation.relaxation(IdentityPlus(helpers.FORMATS[form](gpu, R)), "sor", None, 1.3)
    assert relax.block > 8
    y = gallery.vectors(97, 5, 1)
    b = gallery.vectors(97, 5, 2)
    before = y
    sweeps = relaxation.Sweeps(relax, gpu.upload(y), gpu.upload(b), gpu.upload(b))
    for _ in range(3):
        before = y
        y = reference.sor(np.eye(97) + R, y, b, 1.3)
        sweeps.sweep()
        np.testing.assert_allclose(sweeps.x.get(), y, rtol=0, atol=1e-5)
    residual = b - before - R @ before
    np.testing.assert_allclose(sweeps.r.get(), residual, rtol=0, atol=1e-5)


def test_a_first_sweep_reads_nothing_that_was_not_written(gpu):
    """Its residual is that of no iterate, but a number."""
    R = scipy.sparse.csr_array(gallery.sparse(53, 53) / 20)
    relax = relaxation.relaxation(IdentityPlus(helpers.csr(gpu, R)), "sor", 8, 1.0)
    ones = gpu.upload(np.ones(53))
    sweeps = relaxation.Sweeps(relax, ones.copy(), ones, ones.copy())
    np.testing.assert_array_equal(sweeps.carry.get(), ones.get())
    sweeps.sweep()
    assert np.isfinite(sweeps.r.get()).all()


def speeds(monkeypatch, launch: float, bandwidth: float) -> None:
    monkeypatch.setattr(
        tuning, "overheads", lambda device: tuning.Overheads(launch=launch, wait=1e-5)
    )
    monkeypatch.setattr(tuning, "bandwidth", lambda device: bandwidth)


def test_blocks_grow_with_what_a_launch_costs_beside_bytes(gpu, monkeypatch):
    monkeypatch.setattr(gpu, "memory", 1 << 40)
    monkeypatch.setattr(gpu, "max_allocation", 1 << 38)
    n = 131072
    blocks = []
    for launch in (1e-8, 1e-6, 5e-6, 1e-4):
        speeds(monkeypatch, launch, 4e12)
        blocks.append(triangles.best_block(gpu, n, 128))
    assert blocks[0] == 128
    assert blocks == sorted(set(blocks))
    # Inverses leave room for what they are joined from, and fit in one buffer.
    monkeypatch.setattr(gpu, "memory", 8 * n * 512)
    assert triangles.best_block(gpu, n, 128) == 128
    monkeypatch.setattr(gpu, "memory", 1 << 40)
    monkeypatch.setattr(gpu, "max_allocation", 4 * n * 256 + 16)
    assert triangles.best_block(gpu, n, 128) == 256


def test_a_matrix_of_one_block_needs_no_speeds(gpu, monkeypatch):
    monkeypatch.setattr(tuning, "overheads", lambda device: pytest.fail("measured"))
    assert triangles.best_block(gpu, 100, 100) == 100


@pytest.mark.parametrize("k", [1, 3])
def test_a_solve_takes_two_launches_a_block(gpu, k):
    n = 300
    gpu.max_allocation = gpu.description.max_allocation
    R = scipy.sparse.diags_array([0.4] * (n - 1), offsets=1, shape=(n, n)).tocsr()
    R = R + R.T
    S = IdentityPlus(helpers.csr(gpu, R))
    b = gallery.vectors(n, k)
    solution = ltcl.solve(S, b, "gauss_seidel", rtol=1e-3)
    assert solution.converged
    before = gpu.launches["relax_rows"]
    relax = relaxation.relaxation(S, "gauss_seidel")
    sweeps = relaxation.Sweeps(relax, gpu.upload(b), gpu.upload(b), gpu.upload(b))
    sweeps.sweep()
    assert gpu.launches["relax_rows"] - before == -(-n // relax.block) < n / 128
