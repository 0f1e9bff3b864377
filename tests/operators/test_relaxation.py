# SPDX-License-Identifier: BSD-3-Clause
"""Sweeps over rows: both parts of a launch meet their twins, whatever block, slabs and format."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import CSR, Dense, IdentityPlus, ScaledColumns, Shifted, blocks
from ltcl.operators.blocks import Rows
from ltcl.operators.relaxation import Relaxation, Sweep, block_relaxation, relaxation
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
    state = Sweep(device.upload(x), device.upload(b), device.upload(np.full_like(x, np.nan)))
    for array in (state.before, state.s, state.delta):
        array.set(np.full_like(x, np.nan))
    state.carry.set(carry)
    return state, x, b, carry


def made(rows: Rows, kind: str, block: int, omega: float) -> Relaxation:
    """Sweeps whose blocks are finished in the way `kind`, which is not the one chosen for the device."""
    cut = blocks.cut(rows.M.shape[0], block, overlap=kind != "in sequence")
    if kind == "in sequence":
        return Relaxation(rows, list(blocks.in_sequence(rows, cut)), omega)
    return Relaxation(
        rows, list(blocks.by_inverse(rows, cut, None if kind == "all" else omega, "sor")), omega
    )


KINDS = [
    (form, kind)
    for form in FORMATS
    for kind in ("in sequence", "by inverse", "all")
    if form == "csr" or kind[0] != "i"
]


@pytest.mark.parametrize("launch", ["item", "stream", "group7", "group64"])
@pytest.mark.parametrize("k", [None, 3, 8])
@pytest.mark.parametrize("name", MATRICES)
@pytest.mark.parametrize(("form", "kind"), KINDS)
def test_product_and_finish_meet_their_twins(device, monkeypatch, form, kind, name, k, launch):
    """The launches of two blocks: product, product beside finish, finish."""
    M = MATRICES[name]
    n, half, omega = len(M), -(-len(M) // 2), 1.0 if kind == "all" else 1.3
    A = FORMATS[form](device, M)
    helpers.force(monkeypatch, A, launch)
    state, x, b, carry = sweep_state(device, n, k)
    made(Rows(A, 1.0, -1.0), kind, half, omega).sweep(state)
    csr, S = scipy.sparse.csr_array(M), np.eye(n) - M.astype(np.float64)
    entries = (csr.indptr, csr.indices, csr.data) if form == "csr" else (M,)
    y, delta, wanted = np.array(x, np.float64), np.zeros_like(x, np.float64), []
    for start in range(0, n, half):
        before, stop = 0 if kind != "in sequence" else start, min(start + half, n)
        found = getattr(reference, f"relax_{form}")(*entries, before, 1.0, -1.0, x, y, b, carry)
        wanted.append([values[start:stop] for values in found])
        s = np.concatenate([values[0] for values in wanted])
        chosen = None if kind == "all" else omega
        delta[start:stop] = reference.relax_substitute(S, chosen, before, start, stop, s, delta)
        y[start:stop] = x[start:stop] + delta[start:stop]
    right, r, carry = (np.concatenate(values) for values in zip(*wanted, strict=True))
    found = [(state.r, r), (state.carry, carry), (state.x, y), (state.before, x)]
    if kind == "in sequence":
        found.append((state.s, (delta.T * S.diagonal() / omega).T))
    else:
        found += [(state.s, right), (state.delta, delta)]
    for array, values in found:
        np.testing.assert_allclose(array.get(), values, rtol=0, atol=1e-5)


@pytest.mark.parametrize("block", [1, 2, 7, 16, 53, 64])
@pytest.mark.parametrize(("form", "kind"), KINDS)
def test_sweeps_are_those_of_the_textbook(device, form, kind, block):
    M = MATRICES["sparse 53"]
    S, omega = np.eye(53) + M.astype(np.float64), 1.0 if kind == "all" else 1.3
    relax = made(Rows(FORMATS[form](device, M), 1.0, 1.0), kind, block, omega)
    state, x, b, _ = sweep_state(device, 53, 3)

    def after(sweeps: int) -> np.ndarray:
        if kind == "all":
            return reference.block_gauss_seidel(S, x, b, block, sweeps)
        return reference.sor(S, x, b, omega, sweeps)

    for sweeps in range(1, 4):
        relax.sweep(state)
        np.testing.assert_allclose(state.x.get(), after(sweeps), rtol=0, atol=1e-5)
        np.testing.assert_allclose(state.before.get(), after(sweeps - 1), rtol=0, atol=1e-5)
        if sweeps > 1:
            np.testing.assert_allclose(state.r.get(), b - S @ after(sweeps - 1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("omega", [1.0, 0.7, 1.6])
@pytest.mark.parametrize("block", [1, 2, 7, 16, 53, 64, None])
@pytest.mark.parametrize("form", FORMATS)
def test_the_block_does_not_change_the_iterates(device, form, block, omega):
    M = MATRICES["53"]
    S = np.eye(53) + M.astype(np.float64)
    relax = relaxation(IdentityPlus(FORMATS[form](device, M)), "sor", block, omega)
    state, x, b, _ = sweep_state(device, 53, 3)
    for sweeps in range(1, 5):
        relax.sweep(state)
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
    relax = relaxation(A if block == 1 else IdentityPlus(A, -1), "sor", block, 0.1)
    S = M.astype(np.float64) if block == 1 else np.eye(53) - M.astype(np.float64)
    relax.sweep(state)
    wanted = reference.sor(S, x, b, 0.1)
    np.testing.assert_allclose(state.x.get(), wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())


@pytest.mark.parametrize("form", FORMATS)
def test_sweeps_repeat_to_the_bit(device, form):
    S = IdentityPlus(FORMATS[form](device, MATRICES["53"]))
    found = []
    for _ in range(2):
        state, *_ = sweep_state(device, 53, 5)
        relaxation(S, "gauss_seidel", 8).sweep(state)
        found.append(state.x.get())
    helpers.same_bits(*found)


def test_it_is_made_once_and_lives_with_its_matrix(device):
    R = Dense(device, MATRICES["53"])
    S = IdentityPlus(R)
    assert relaxation(S, "sor", 8) is relaxation(S, "gauss_seidel", 8)
    assert relaxation(S, "sor", 8) is not relaxation(S, "sor", 9)
    assert relaxation(S, "sor", 8) is not relaxation(IdentityPlus(S.R, -1), "sor", 8)
    assert relaxation(S, "sor", 8) is not block_relaxation(S, "block_gauss_seidel", 8)
    assert relaxation(S, "sor", 8, 1.2).omega == 1.2
    assert relaxation(S, "sor", 8).omega == 1.0
    assert len(R.relaxations) == 4  # another omega takes the place of the one before


def test_pieces_on_the_host_change_nothing(device, monkeypatch):
    M = gallery.sparse(53, 53, 0.5)
    M.data /= 20
    state, x, b, _ = sweep_state(device, 53, None)
    monkeypatch.setattr(blocks, "_PIECE", 10)
    relaxation(IdentityPlus(CSR(device, M)), "sor", 7).sweep(state)
    wanted = reference.sor(np.eye(53) + M.toarray().astype(np.float64), x, b)
    np.testing.assert_allclose(state.x.get(), wanted, rtol=0, atol=1e-5)


def test_the_default_block_shrinks_where_triangles_are_full(device):
    full, empty = np.ones((1024, 1024)), np.eye(1024)
    sizes = [blocks.best_size(CSR(device, scipy.sparse.csr_array(M)), sequential=True) for M in (full, empty)]
    assert sizes[0] < 1024 < sizes[1]


@pytest.mark.parametrize("form", FORMATS)
def test_a_block_may_cross_slabs(small_device, form):
    M = gallery.signed(53, 53, 4) / 20
    A = FORMATS[form](small_device, M)
    assert len(A.slabs) > 1
    S = np.eye(53) + M.astype(np.float64)
    state, x, b, _ = sweep_state(small_device, 53, 2)
    relax = block_relaxation(IdentityPlus(A), "block_gauss_seidel", 20)
    for sweeps in (1, 2):
        relax.sweep(state)
        wanted = reference.block_gauss_seidel(S, x, b, 20, sweeps)
        np.testing.assert_allclose(state.x.get(), wanted, rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        state.r.get(), b - S @ reference.block_gauss_seidel(S, x, b, 20), rtol=0, atol=1e-5
    )


@pytest.mark.parametrize("form", FORMATS)
def test_inverses_beyond_the_device_are_refused_with_both_sizes(device, monkeypatch, form):
    S = IdentityPlus(FORMATS[form](device, MATRICES["53"]))
    monkeypatch.setattr(device, "memory", 1000)
    with pytest.raises(
        MemoryLimitError, match=r"'block_gauss_seidel' with inverses of 4 blocks needs .* has"
    ):
        block_relaxation(S, "block_gauss_seidel", 16)


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
