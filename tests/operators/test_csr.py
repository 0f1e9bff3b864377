# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices on the device: what is taken, twins of the kernels, shared patterns, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR
from tests import gallery, reference
from tests.operators import helpers


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


def test_what_is_not_a_sparse_matrix_is_refused(device):
    with pytest.raises(InputTypeError, match="matrix is a ndarray"):
        CSR(device, np.eye(3))
    bad = gallery.sparse(9, 9)
    bad.indices[0] = 9
    with pytest.raises(InputError, match=r"matrix\.indices holds 9"):
        CSR(device, bad)


@pytest.mark.parametrize("name", gallery.SPARSE)
def test_products_meet_their_twin(device, name):
    matrix = gallery.SPARSE[name]

    def twin(*arguments):
        return reference.csr_matvec(matrix.indptr, matrix.indices, matrix.data, *arguments)

    helpers.meets_twin(CSR(device, matrix), matrix.toarray(), twin)
