# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices on the device: every variant of every product, slabs, shared patterns, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import CSR
from tests import gallery, reference
from tests.conftest import ROOM
from tests.operators import helpers

SLABBED = {
    **gallery.SPARSE,
    "53x53": gallery.sparse(53, 53, 0.9),
    # As many row pointers as a buffer takes, and one more.
    "one a row": scipy.sparse.csr_array(np.ones((ROOM, 1), np.float32)),
    "empty rows": scipy.sparse.csr_array((ROOM, 2), dtype=np.float32),
}


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize("launch", helpers.LAUNCHES)
def test_products_meet_their_twin(device, monkeypatch, name, launch):
    matrix = gallery.SPARSE[name]
    A = CSR(device, matrix)
    helpers.force(monkeypatch, A, launch)

    def twin(*arguments):
        return reference.csr_matvec(matrix.indptr, matrix.indices, matrix.data, *arguments)

    helpers.meets_twin(A, matrix.toarray(), twin)


@pytest.mark.parametrize("name", gallery.SPARSE)
def test_default_products_and_transposes_meet_their_twin(device, name):
    matrix = gallery.SPARSE[name]
    A = CSR(device, matrix)
    helpers.meets_twin(A, matrix.toarray())
    helpers.meets_twin(A, matrix.toarray(), transpose=True)


@pytest.mark.parametrize("form", ["csc", "coo", "lil", "dok", "bsr", "dia"])
def test_any_sparse_format_is_taken(device, form):
    matrix = gallery.SPARSE["53x7"]
    A = CSR(device, matrix.asformat(form))
    np.testing.assert_array_equal(A.to_dense(), matrix.toarray())
    helpers.meets_twin(A, matrix.toarray())


def test_unsorted_and_repeated_entries_are_put_in_order(device):
    # Row 0: 24 columns backwards, each twice. The fast path for neighbours relies on ascending columns.
    columns = np.repeat(np.arange(24)[::-1], 2)
    values = np.arange(48, dtype=np.float32)
    matrix = scipy.sparse.csr_array((values, columns, [0, 48]), shape=(1, 24))
    before = matrix.indices.copy()
    A = CSR(device, matrix)
    helpers.meets_twin(A, (values[::2] + values[1::2])[None, ::-1])
    np.testing.assert_array_equal(matrix.indices, before)  # the user's matrix is left alone


@pytest.mark.parametrize("name", SLABBED)
def test_slabs_give_the_same_as_one_buffer(device, small_device, name):
    matrix = SLABBED[name]
    rows, columns = matrix.toarray().shape
    whole, cut = CSR(device, matrix), CSR(small_device, matrix)
    for k in (None, 1, 3):
        if max(rows, columns) * (k or 1) <= ROOM:
            x = gallery.vectors(columns, k)
            one, many = (A.apply(A.device.upload(x)).get() for A in (whole, cut))
            helpers.same_rows(device, one, many, reference.product_error(matrix.toarray(), x))


def test_transposes_in_slabs_meet_their_twin(small_device):
    matrix = gallery.sparse(53, 53, 0.9)
    A = CSR(small_device, matrix)
    assert len(A.slabs) > 1
    helpers.meets_twin(A, matrix.toarray(), transpose=True)


def test_row_beyond_the_largest_buffer_is_refused_with_both_sizes(small_device):
    with pytest.raises(MemoryLimitError, match=r"row 1 of the sparse matrix has 3.98\d KiB.* 3\.98 KiB"):
        CSR(small_device, scipy.sparse.csr_array([np.zeros(ROOM), np.ones(ROOM)]))


def test_memory_is_asked_before_anything_is_allocated(device, monkeypatch):
    monkeypatch.setattr(device, "memory", 100)
    monkeypatch.setattr(Device, "empty", lambda *_: pytest.fail("allocated"))
    with pytest.raises(MemoryLimitError, match=r"needs .* but .* has 100 B"):
        CSR(device, gallery.SPARSE["53x7"])


def test_channels_with_one_pattern_store_it_once(device):
    red = gallery.sparse(53, 53)
    green = red.copy()
    green.data = -2 * red.data
    first = CSR(device, red)
    second = CSR(device, green, first.pattern)
    assert second.pattern is first.pattern
    for a, b in zip(first.slabs, second.slabs, strict=True):
        pointers, columns, values = b.arguments
        assert (pointers, columns) == a.arguments[:2]  # arrays compare by identity
        assert values is not a.arguments[2]
    helpers.meets_twin(second, green.toarray())


@pytest.mark.parametrize(
    "other", [gallery.sparse(53, 53, seed=5), gallery.sparse(53, 54), gallery.sparse(52, 53)]
)
def test_pattern_of_another_matrix_is_not_used(device, other):
    A = CSR(device, other, CSR(device, gallery.sparse(53, 53)).pattern)
    helpers.meets_twin(A, other.toarray())


def test_pattern_of_another_device_is_not_used(device, small_device):
    matrix = gallery.sparse(9, 9)
    A = CSR(device, matrix, CSR(small_device, matrix).pattern)
    assert A.pattern.device is device


def test_bytes_are_those_of_the_buffers(device):
    A = CSR(device, gallery.sparse(53, 7))
    assert A.nbytes == 8 * A.nnz + 4 * 54
    A.apply_transpose(device.upload(np.ones(53)))
    assert A.nbytes == 16 * A.nnz + 4 * 54 + 4 * 8


@pytest.mark.parametrize("name", gallery.SPARSE)
def test_facts_about_the_entries(device, name):
    matrix = gallery.SPARSE[name].toarray().astype(np.float64)
    A = CSR(device, gallery.SPARSE[name])
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    np.testing.assert_array_equal(A.to_dense(), matrix)
    helpers.norms_match(A, matrix, rel=1e-5)


def test_what_is_not_a_sparse_matrix_is_refused(device):
    with pytest.raises(InputTypeError, match="matrix is a ndarray"):
        CSR(device, np.eye(3))
    bad = gallery.sparse(9, 9)
    bad.indices[0] = 9
    with pytest.raises(InputError, match=r"matrix\.indices holds 9"):
        CSR(device, bad)
