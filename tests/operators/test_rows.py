# SPDX-License-Identifier: BSD-3-Clause
"""What all matrices in rows have in common: products and steps of every launch, slabs, facts, refusals."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from ltcl.device import Device, tuning
from ltcl.errors import MemoryLimitError
from ltcl.operators import CSR, Dense, IdentityPlus, RowBlocks, Tiles, rows
from tests import gallery, reference
from tests.conftest import ROOM
from tests.operators import helpers


def in_blocks(device, matrix):
    """Three blocks of rows, the last one of what is left."""
    size = -(-matrix.shape[0] // 3)
    starts = range(0, matrix.shape[0], size)
    return RowBlocks(device, matrix.shape, lambda: ((k, matrix[k : k + size]) for k in starts), matrix.nnz)


FORMATS = {
    "csr": CSR,
    "blocks": in_blocks,
    "dense": lambda device, matrix: Dense(device, matrix.toarray()),
    "tiles of 1": lambda device, matrix: Tiles(device, matrix, 1, "float16"),
    "tiles of 8": lambda device, matrix: Tiles(device, matrix, 8, "float32"),
    "bytes": lambda device, matrix: Tiles(device, matrix, 8, "int8"),
}
formats = pytest.mark.parametrize("make", FORMATS.values(), ids=list(FORMATS))
KERNELS = [FORMATS[name] for name in ("csr", "dense", "tiles of 1", "tiles of 8", "bytes")]
NAMES = sorted({*gallery.SPARSE} - {"129x129"})


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("make", KERNELS)
@pytest.mark.parametrize("launch", helpers.LAUNCHES)
def test_products_of_every_launch_meet_their_twin(device, monkeypatch, name, make, launch):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 5, 10))  # launches of every width, alone and not
    A = make(device, gallery.SPARSE[name])
    helpers.force(monkeypatch, A, launch)
    helpers.meets_twin(A, A.to_dense())


@pytest.mark.parametrize("make", KERNELS)
@pytest.mark.parametrize("launch", helpers.LAUNCHES)
def test_steps_of_every_launch_meet_their_twin(device, monkeypatch, make, launch):
    R = make(device, scipy.sparse.csr_array(gallery.signed(53, 53) / 53))
    helpers.force(monkeypatch, R, launch)
    helpers.steps_match(IdentityPlus(R, -1.0), np.eye(53) - R.to_dense(), (None, 3, 11))


@formats
@pytest.mark.parametrize("name", gallery.SPARSE)
def test_default_products_transposes_and_facts(device, monkeypatch, name, make):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 2, 11))
    A = make(device, gallery.SPARSE[name])
    matrix = A.to_dense()
    if not isinstance(A, Tiles):
        np.testing.assert_array_equal(matrix, gallery.SPARSE[name].toarray())
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    norms = A.norms()
    assert norms.one == pytest.approx(np.linalg.norm(matrix, 1), rel=1e-12)
    assert norms.inf == pytest.approx(np.linalg.norm(matrix, np.inf), rel=1e-12)
    assert norms.frobenius == pytest.approx(np.linalg.norm(matrix, "fro"), rel=1e-12)
    assert norms.lowest == min(matrix.min(initial=0.0), 0.0)


@formats
def test_slabs_give_the_same_as_one_buffer(device, small_device, make):
    matrix = gallery.SPARSE["129x129"] + gallery.SPARSE["129x129"].T
    whole, cut = make(device, matrix), make(small_device, matrix)
    assert len(cut.slabs) > len(whole.slabs)
    for k in (None, 3):
        x = gallery.vectors(129, k)
        one, many = (A.apply(A.device.upload(x)).get() for A in (whole, cut))
        helpers.same_rows(device, one, many, reference.product_error(whole.to_dense(), x))
    np.testing.assert_array_equal(whole.to_dense(), cut.to_dense())


@formats
def test_transposes_and_steps_in_slabs_meet_their_twin(small_device, monkeypatch, make):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3))
    A = make(small_device, scipy.sparse.csr_array(gallery.signed(65, 65) / 65))
    assert len(A.slabs) > 1
    helpers.meets_twin(A, A.to_dense(), transpose=True)
    helpers.steps_match(IdentityPlus(A), np.eye(65) + A.to_dense(), (None, 3))


@pytest.mark.parametrize("shape", [(ROOM, 1), (ROOM, 2)])
def test_as_many_row_pointers_as_a_buffer_takes_and_one_more(small_device, shape):
    A = CSR(small_device, scipy.sparse.csr_array(np.ones(shape, np.float32) * (shape[1] == 1)))
    np.testing.assert_array_equal(A @ np.ones(shape[1]), np.full(ROOM, float(shape[1] == 1)))


@formats
def test_a_row_beyond_the_largest_buffer_is_refused_with_both_sizes(small_device, make):
    matrix = scipy.sparse.csr_array([np.zeros(4 * ROOM), np.ones(4 * ROOM)])
    with pytest.raises(MemoryLimitError, match=r"row \d of .* has \d.* KiB.* 3\.98"):
        make(small_device, matrix)


@formats
def test_memory_is_asked_before_anything_is_allocated(device, monkeypatch, make):
    monkeypatch.setattr(device, "memory", 100)
    monkeypatch.setattr(Device, "empty", lambda *_: pytest.fail("allocated"))
    with pytest.raises(MemoryLimitError, match=r"needs .* but .* has 100 B"):
        make(device, gallery.SPARSE["53x7"])


@formats
def test_bytes_are_those_of_the_buffers(device, make):
    A = make(device, gallery.SPARSE["53x7"])
    arrays = {one for slab in A.slabs for one in slab.arguments if not isinstance(one, int)}
    assert A.nbytes == sum(one.nbytes for one in arrays)
    before = A.nbytes
    A.apply_transpose(device.upload(np.ones(53)))
    assert A.nbytes == before + (0 if isinstance(A, Dense) else A.transposed_copy().nbytes)


@formats
def test_products_repeat_to_the_bit(device, make):
    A = make(device, gallery.sparse(65, 53))
    x, y = gallery.vectors(53, 3), gallery.vectors(65, 3)
    helpers.same_bits(A @ x, A @ x)
    helpers.same_bits(A.T @ y, A.T @ y)


@pytest.fixture
def asked(monkeypatch):
    """The problems `tuning.choose` was asked about; it answers with the last of the variants."""
    calls = []

    def choose(device, file, problem, variants):
        for launch in variants.values():
            launch()
        calls.append(problem)
        return list(variants)[-1]

    monkeypatch.setattr(tuning, "choose", choose)
    return calls


@pytest.mark.parametrize("make", [FORMATS["csr"], FORMATS["dense"]])
def test_each_width_of_large_matrices_is_timed_once(device, asked, monkeypatch, make):
    A = make(device, gallery.sparse(65, 53))
    if device.is_cpu:
        A.matvec(np.ones(53))
        assert not asked  # small ones take the first variant
    monkeypatch.setattr(rows, "_WORTH_TIMING", 0)
    for _ in range(2):
        A.matmat(np.ones((53, 11)))
    assert ["k=8 of 11" in problem for problem in asked[-2:]] == [True, False]
    helpers.meets_twin(A, A.to_dense())  # trials leave the operands alone, also where `out` is one


def test_kernels_of_different_tiles_are_timed_apart(device, asked, monkeypatch):
    """The answer of one width or precision was that of all others."""
    monkeypatch.setattr(rows, "_WORTH_TIMING", 0)
    kinds = list(itertools.product((1, 8), ("float32", "float16", "int8")))
    for kind in kinds:
        Tiles(device, gallery.SPARSE["stretches"], *kind).matvec(np.ones(97))
    assert len(set(asked)) == len(kinds)


@settings(deadline=None)
@given(st.lists(st.integers(0, 20), max_size=40), st.integers(20, 60))
def test_slabs_cover_all_rows_within_the_limit_and_are_few(row_bytes, limit):
    pieces = rows.cut(np.array(row_bytes, np.int64), limit, "A")
    assert (pieces[0][0], pieces[-1][1]) == (0, len(row_bytes))
    assert all(a[1] == b[0] for a, b in itertools.pairwise(pieces))
    assert all(sum(row_bytes[start:stop]) <= limit for start, stop in pieces)
    # As few as possible: no slab has room for the first row of the next.
    assert all(sum(row_bytes[a : b + 1]) > limit for a, b in pieces[:-1])


@pytest.mark.parametrize(("allowed", "limit"), [(4096, 4096), (1 << 34, 1 << 33), (1 << 33, 1 << 33)])
def test_positions_within_a_slab_stay_32_bit_numbers(allowed, limit):
    found = rows.largest(SimpleNamespace(max_allocation=allowed))  # pyright: ignore[reportArgumentType]
    assert found <= limit
    # Kernels step along a row by up to 256 beyond its end.
    assert found // 4 + 256 < 1 << 31
