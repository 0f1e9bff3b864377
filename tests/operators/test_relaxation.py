# SPDX-License-Identifier: BSD-3-Clause
"""Sweeps over rows: both launches of a block meet their twins, whatever block, slabs and format."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus, ScaledColumns, Shifted, triangles
from ltcl.operators.relaxation import Relaxation, Rows, Sweep, relaxation
from tests import gallery, reference
from tests.operators import helpers

FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
MATRICES = {
    "1x1": np.array([[0.25]], np.float32),
    "no entries": np.zeros((5, 5), np.float32),
    "53": gallery.signed(53, 53, 3) / 20,
    "sparse 53": gallery.sparse(53, 53, 0.3).toarray() / 20,
    "empty rows": np.where(np.arange(40)[:, None] % 3 == 1, gallery.signed(40, 40) / 20, np.float32(0)),
    "runs": np.tril(np.triu(gallery.signed(97, 97, 5), -40), 40) / 30,
    "below only": np.tril(gallery.signed(33, 33, 6), -1) / 9,
    "above only": np.triu(gallery.signed(33, 33, 7), 1) / 9,
}


def sweep_state(device, n: int, k: int | None) -> tuple[Sweep, np.ndarray, np.ndarray, np.ndarray]:
    x, b, carry = (gallery.vectors(n, k, seed) for seed in (1, 2, 3))
    garbage = np.full_like(x, np.nan)
    s, r = device.upload(garbage), device.upload(garbage)
    return Sweep(device.upload(x), device.upload(b), s, r, device.upload(carry)), x, b, carry


@pytest.mark.parametrize("launch", ["item", "stream", "group7", "group64"])
@pytest.mark.parametrize("k", [None, 3, 8])
@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize("form", FORMATS)
def test_both_launches_meet_their_twins(device, monkeypatch, form, name, k, launch):
    M = MATRICES[name]
    A = FORMATS[form](device, M)
    helpers.force(monkeypatch, A, launch)
    relax = Relaxation(Rows(A, 1.0, -1.0), 1 << 20)
    state, x, b, carry = sweep_state(device, len(M), k)
    relax.sweep(state, 1.3)
    csr = scipy.sparse.csr_array(M)
    entries = (csr.indptr, csr.indices, csr.data) if form == "csr" else (M,)
    product = getattr(reference, f"relax_{form}")
    triangle = getattr(reference, f"relax_{form}_triangle")
    s, r, upper = product(*entries, slice(None), 1.0, -1.0, x, b, carry)
    delta = triangle(*entries, slice(None), 1.0, -1.0, 1.3, s)
    left = (delta.T * (1.0 - M.diagonal().astype(float)) / 1.3).T
    for found, wanted in (
        (state.x, x + delta),
        (state.s, delta),
        (state.r, r),
        (state.carry, upper + (1 - 1.3) * left),
    ):
        np.testing.assert_allclose(found.get(), wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("omega", [1.0, 0.7, 1.6])
@pytest.mark.parametrize("block", [1, 2, 7, 16, 53, 64, None])
@pytest.mark.parametrize("form", FORMATS)
def test_the_block_does_not_change_the_iterates(device, form, block, omega):
    M = MATRICES["53"]
    S = np.eye(53) + M.astype(np.float64)
    relax = relaxation(IdentityPlus(FORMATS[form](device, M)), "sor", block)
    state, x, b, _ = sweep_state(device, 53, 3)
    for sweeps in range(1, 5):
        relax.sweep(state, omega)
        np.testing.assert_allclose(state.x.get(), reference.sor(S, x, b, omega, sweeps), rtol=0, atol=1e-5)
        if sweeps > 1:  # the residual is that of the iterate before
            before = reference.sor(S, x, b, omega, sweeps - 1)
            np.testing.assert_allclose(state.r.get(), b - S @ before, rtol=0, atol=1e-5)


@pytest.mark.parametrize("block", [1, 5, None])
@pytest.mark.parametrize("form", FORMATS)
def test_slabs_give_the_same_as_one_buffer(small_device, form, block):
    M = gallery.signed(53, 53, 4) / 20
    A = FORMATS[form](small_device, M)
    assert len(A.slabs) > 1
    state, x, b, _ = sweep_state(small_device, 53, 2)
    relax = relaxation(A, "sor", block) if block == 1 else relaxation(IdentityPlus(A, -1), "sor", block)
    S = M.astype(np.float64) if block == 1 else np.eye(53) - M.astype(np.float64)
    relax.sweep(state, 0.1)
    wanted = reference.sor(S, x, b, 0.1)
    np.testing.assert_allclose(state.x.get(), wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("form", FORMATS)
def test_sweeps_repeat_to_the_bit(device, form):
    S = IdentityPlus(FORMATS[form](device, MATRICES["53"]))
    found = []
    for _ in range(2):
        state, *_ = sweep_state(device, 53, 5)
        relaxation(S, "gauss_seidel", 8).sweep(state, 1.0)
        found.append(state.x.get())
    helpers.same_bits(*found)


def test_it_is_made_once_and_lives_with_its_matrix(device):
    S = IdentityPlus(Dense(device, MATRICES["53"]))
    assert relaxation(S, "sor", 8) is relaxation(S, "gauss_seidel", 8)
    assert relaxation(S, "sor", 8) is not relaxation(S, "sor", 9)
    assert relaxation(S, "sor", 8) is not relaxation(IdentityPlus(S.R, -1), "sor", 8)


def test_pieces_on_the_host_change_nothing(device, monkeypatch):
    M = gallery.sparse(53, 53, 0.5)
    M.data /= 20
    state, x, b, _ = sweep_state(device, 53, None)
    monkeypatch.setattr(triangles, "_PIECE", 10)
    relaxation(IdentityPlus(CSR(device, M)), "sor", 7).sweep(state, 1.0)
    wanted = reference.sor(np.eye(53) + M.toarray().astype(np.float64), x, b)
    np.testing.assert_allclose(state.x.get(), wanted, rtol=0, atol=1e-5)


def test_the_default_block_shrinks_where_triangles_are_full(device):
    full, empty = np.ones((1024, 1024)), np.eye(1024)
    blocks = [triangles.best_block(CSR(device, scipy.sparse.csr_array(M))) for M in (full, empty)]
    assert blocks[0] < 1024 < blocks[1]


@pytest.mark.parametrize(
    "make", [lambda A: ScaledColumns(A, np.ones(5)), lambda A: IdentityPlus(Shifted(A)), lambda A: A.T]
)
def test_operators_without_rows_are_refused(device, make):
    with pytest.raises(
        InputError, match=r"method='sor' reads S row by row, which .*; give .*chebyshev"
    ) as caught:
        relaxation(make(Dense(device, np.eye(5))), "sor")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", FORMATS)
def test_a_zero_on_the_diagonal_is_refused_by_row(device, form):
    M = np.diag([1.0, -1.0, 0.0])
    with pytest.raises(InputError, match=r"diagonal of S, which is 0 in 1 row\(s\), first in row 1"):
        relaxation(IdentityPlus(FORMATS[form](device, M)), "gauss_seidel")
    with pytest.raises(InputError, match="first in row 2"):
        relaxation(FORMATS[form](device, M), "gauss_seidel")
