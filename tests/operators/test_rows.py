# SPDX-License-Identifier: BSD-3-Clause
"""Matrices in rows, sparse and dense: products and steps of every launch, slabs, memory."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from ltcl.device import Device, tuning
from ltcl.errors import MemoryLimitError
from ltcl.operators import (
    CSR,
    Dense,
    Filled,
    IdentityPlus,
    RowBlocks,
    Tiles,
    as_operator,
    rows,
)
from tests import gallery, reference
from tests.conftest import ROOM
from tests.operators import helpers


def three_blocks(matrix: Any) -> Iterator[tuple[int, Any]]:
    """Three blocks of rows, the last one of the rest."""
    size = -(-matrix.shape[0] // 3)
    for first in range(0, matrix.shape[0], size):
        yield first, matrix[first : first + size]


def in_blocks(device: Device, matrix: Any) -> RowBlocks:
    return RowBlocks(device, matrix.shape, lambda: three_blocks(matrix), matrix.nnz)


def filled(device: Device, matrix: Any) -> Filled:
    return Filled(device, matrix.shape, lambda: three_blocks(matrix))


formats = pytest.mark.parametrize(
    "make",
    [*helpers.FORMATS.values(), in_blocks, filled],
    ids=[*helpers.FORMATS, "blocks", "filled"],
)
kernels = pytest.mark.parametrize("make", helpers.FORMATS.values(), ids=list(helpers.FORMATS))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted({*gallery.SPARSE} - {"129x129"}))
@kernels
@pytest.mark.parametrize("launch", helpers.LAUNCHES)
def test_products_of_every_launch_meet_their_twin(device, monkeypatch, name, make, launch):
    # Launches of every width, alone and not.
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 5, 10))
    A = make(device, gallery.SPARSE[name])
    helpers.force(monkeypatch, A, launch)
    helpers.meets_twin(A, A.to_dense())


@pytest.mark.slow
@kernels
@pytest.mark.parametrize("launch", helpers.LAUNCHES)
def test_steps_of_every_launch_meet_their_twin(device, monkeypatch, make, launch):
    R = make(device, scipy.sparse.csr_array(gallery.signed(53, 53) / 53))
    helpers.force(monkeypatch, R, launch)
    helpers.steps_match(IdentityPlus(R, -1.0), np.eye(53) - R.to_dense(), (None, 3, 11))


@pytest.mark.slow
@formats
@pytest.mark.parametrize("name", gallery.SPARSE)
def test_default_products_transposes_and_facts(device, monkeypatch, name, make):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 2, 11))
    given = gallery.SPARSE[name]
    A = make(device, given)
    matrix = A.to_dense()
    if not isinstance(A, Tiles):
        twin = reference.csr_matvec(given.indptr, given.indices, given.data, np.eye(A.shape[1]))
        np.testing.assert_array_equal(matrix, twin)
    helpers.meets_twin(A, matrix)
    helpers.meets_twin(A, matrix, transpose=True)
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    helpers.norms_match(A, matrix)


@pytest.mark.slow
@formats
def test_slabs_give_the_same_as_one_buffer(device, small_device, monkeypatch, make):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3))
    matrix = (gallery.SPARSE["129x129"] + gallery.SPARSE["129x129"].T) / 20
    whole = make(device, matrix)
    cut = make(small_device, matrix)
    assert len(cut.slabs) > len(whole.slabs)
    dense = whole.to_dense()
    np.testing.assert_array_equal(dense, cut.to_dense())
    for k in helpers.COLUMNS:
        x = gallery.vectors(129, k)
        one = helpers.product(whole, x)
        many = helpers.product(cut, x)
        helpers.same_rows(device, one, many, reference.product_error(dense, x))
    helpers.meets_twin(cut, dense, transpose=True)
    helpers.steps_match(IdentityPlus(cut), np.eye(129) + dense, helpers.COLUMNS)


def test_one_row_pointer_more_than_a_buffer_takes(small_device):
    A = CSR(small_device, scipy.sparse.csr_array(np.ones((ROOM, 1), np.float32)))
    np.testing.assert_array_equal(A @ np.ones(1), np.ones(ROOM))


@formats
def test_memory_is_asked_before_anything_is_allocated(device, small_device, monkeypatch, make):
    row = scipy.sparse.csr_array([np.zeros(4 * ROOM), np.ones(4 * ROOM)])
    with pytest.raises(MemoryLimitError, match=r"row \d of .* has \d.* KiB.* 3\.98"):
        make(small_device, row)
    monkeypatch.setattr(device, "memory", 100)
    monkeypatch.setattr(Device, "empty", lambda *_: pytest.fail("allocated"))
    with pytest.raises(MemoryLimitError, match=r"needs .* but .* has 100 B"):
        make(device, gallery.SPARSE["53x7"])


@formats
def test_bytes_are_those_of_the_buffers(device, make):
    A = make(device, gallery.SPARSE["53x7"])
    arrays = set()
    for slab in A.slabs:
        arrays |= set(slab.arrays)
    before = A.nbytes
    assert before == sum(array.nbytes for array in arrays)
    A.apply_transpose(device.upload(np.ones(53)))
    transposed = 0 if isinstance(A, Dense) else A.transposed_copy().nbytes
    assert A.nbytes == before + transposed


def test_few_zeros_become_dense(device):
    """They took twice the bytes and time, beside the same numbers in an array."""
    matrix = np.random.default_rng(0).uniform(-1.0, 1.0, (512, 512))
    sparse = scipy.sparse.csr_array(np.where(matrix > -0.9, matrix, 0.0))
    A = as_operator(sparse, device)
    assert isinstance(A, Filled)
    x = gallery.vectors(512, 3).astype(np.float64)
    product = A.product_float64()
    assert product is not None
    np.testing.assert_allclose(product(x), sparse @ x, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(A.to_dense(), sparse.toarray())
    mostly_zeros = scipy.sparse.csr_array(np.where(matrix > 0.9, matrix, 0.0))
    assert isinstance(as_operator(mostly_zeros, device), CSR)


@pytest.fixture
def asked(monkeypatch, device):
    """The problems that `tuning.choose` was asked about; it answers with the last variant."""
    calls = []

    def choose(device, file, problem, variants):
        *_, last = variants
        variants[last]()
        calls.append(problem)
        return last

    monkeypatch.setattr(tuning, "choose", choose)
    # CPUs have one kernel.
    monkeypatch.setattr(device, "kind", "gpu")
    return calls


@pytest.mark.slow
@pytest.mark.parametrize("form", helpers.ROWS)
def test_each_width_of_large_matrices_is_timed_once(device, asked, form):
    A = helpers.FORMATS[form](device, gallery.sparse(65, 53))
    for _ in range(2):
        A.matmat(np.ones((53, 11)))
    assert ["k=8 of 11" in problem for problem in asked] == [True, False]
    # Trials leave the operands alone, also `out` if it is one.
    helpers.meets_twin(A, A.to_dense())


@pytest.mark.parametrize("subgroup", [8, 32, 64])
@pytest.mark.parametrize("max_group", [8, 256, 1024])
@pytest.mark.parametrize("entries", [0, 1, 40, 256, 5000])
@pytest.mark.parametrize("form", ["csr", "dense", "tiles of 8"])
def test_groups_of_rows_follow_row_length_and_subgroups(
    device, monkeypatch, form, entries, max_group, subgroup
):
    """Whole sub-groups, which rows share as long as items have something to do."""
    ones = scipy.sparse.csr_array(np.ones((3, entries), np.float32))
    A = helpers.FORMATS[form](device, ones)
    monkeypatch.setattr(device, "kind", "gpu")
    monkeypatch.setattr(device, "max_group", max_group)
    monkeypatch.setattr(type(device), "subgroup", subgroup)
    variants = [variant for variant in A.variants().values() if variant.shared]
    for variant in variants:
        assert variant.group <= max_group
        assert variant.group % min(subgroup, max_group) == 0
        assert variant.group % variant.rows == 0
    default = variants[0]
    turns = entries / A.entries_of_turn / (default.group // default.rows)
    assert turns < 4 or default.rows == 1
    if entries == 256 and max_group == 1024 and subgroup == 32:
        rows = {"csr": 4, "dense": 4, "tiles of 8": 8}[form]
        assert (default.rows, default.group) == (rows, 128)


@pytest.mark.slow
def test_kernels_of_different_tiles_are_timed_apart(device, asked):
    """The answer of one width or precision was that of all others."""
    kinds = list(itertools.product((1, 8), ("float32", "float16", "int8")))
    for kind in kinds:
        Tiles(device, gallery.SPARSE["stretches"], *kind).matvec(np.ones(97))
    assert len(set(asked)) == len(kinds)


def test_slabs_have_no_more_values_than_32_bits_count(device, monkeypatch):
    """Also 256 of a work-group beyond the end of a row, whatever the device would allow."""
    monkeypatch.setattr(device, "max_allocation", 1 << 40)
    start, stop = rows.cut(device, np.full(9, 1 << 30), "A")[0]
    assert (stop - start) * (1 << 28) + 256 < 1 << 31


@pytest.mark.slow
@pytest.mark.parametrize("name", gallery.DENSE)
@pytest.mark.parametrize(("strip", "strips"), [(1, 1), (1, 16), (256, 1)])
def test_dense_transposes_meet_their_twin(device, monkeypatch, name, strip, strips):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 2, 11))
    matrix = gallery.DENSE[name]
    A = Dense(device, matrix)
    monkeypatch.setattr(A, "defines", {"STRIP": strip, "STRIPS": strips})
    helpers.meets_twin(A.T, reference.dense_rmatvec(matrix, np.eye(len(matrix))))


@pytest.mark.parametrize(("rows", "columns"), [(33, 5), (300, 16), (500, 33), (2100, 3)])
def test_slices_of_a_dense_transpose_add_up(shaped, rows, columns):
    """On a GPU a group has many slices of the rows, up to 64 and fewer than its limit allows."""
    random = np.random.default_rng(0)
    matrix = random.normal(size=(rows, columns)).astype(np.float32)
    A = Dense(shaped, matrix)
    for x in (random.normal(size=rows), random.normal(size=(rows, 11))):
        expected = matrix.T.astype(np.float64) @ x
        np.testing.assert_allclose(A.T @ x, expected, rtol=0, atol=1e-5 * rows**0.5)


def test_unsorted_and_repeated_entries_are_put_in_order(device):
    """The fast path for neighbours relies on ascending columns."""
    # 24 columns backwards, each twice.
    columns = np.repeat(np.arange(24)[::-1], 2)
    values = np.arange(48, dtype=np.float32)
    matrix = scipy.sparse.csr_array((values, columns, [0, 48]), shape=(1, 24))
    before = matrix.indices.copy()
    helpers.meets_twin(CSR(device, matrix), (values[::2] + values[1::2])[None, ::-1])
    # The user's matrix is left alone.
    np.testing.assert_array_equal(matrix.indices, before)


def test_channels_with_one_pattern_store_it_once(device, small_device):
    red = gallery.sparse(53, 53)
    first = CSR(device, red)
    second = CSR(device, -2 * red, first.pattern)
    assert second.pattern is first.pattern
    assert len(first.arrays() | second.arrays()) == len(first.arrays()) + len(second.slabs)
    helpers.meets_twin(second, -2 * red.toarray())
    for other in (gallery.sparse(53, 53, seed=5), gallery.sparse(53, 54), gallery.sparse(52, 53)):
        helpers.meets_twin(CSR(device, other, first.pattern), other.toarray())
    assert CSR(small_device, red, first.pattern).pattern is not first.pattern


@pytest.mark.parametrize("dtype", ["float64", "float16", "int16", "uint8", "bool"])
def test_any_sparse_format_and_real_numbers_of_any_type_are_taken(device, dtype):
    matrix = np.array([[1, 0], [1, 1]], dtype)
    sparse = scipy.sparse.csr_array(matrix.astype(float))
    np.testing.assert_array_equal(Dense(device, matrix) @ np.array([2, 3]), [2, 5])
    for form in ("csc", "coo", "lil", "dok", "bsr", "dia"):
        A = CSR(device, sparse.asformat(form))
        np.testing.assert_array_equal(A @ np.array([2, 3]), [2, 5])
