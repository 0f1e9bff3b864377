# SPDX-License-Identifier: BSD-3-Clause
"""Dense matrices on the device: every variant of every product, slabs, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Dense
from tests import gallery, reference
from tests.conftest import ROOM
from tests.operators import helpers


@pytest.mark.parametrize("name", gallery.DENSE)
@pytest.mark.parametrize("launch", helpers.LAUNCHES)
def test_products_meet_their_twin(device, monkeypatch, name, launch):
    A = Dense(device, gallery.DENSE[name])
    helpers.force(monkeypatch, A, launch)
    helpers.meets_twin(A, gallery.DENSE[name])


@pytest.mark.parametrize("name", gallery.DENSE)
@pytest.mark.parametrize("lanes", [1, 8])
def test_transposes_meet_their_twin(device, monkeypatch, name, lanes):
    matrix = gallery.DENSE[name]
    A = Dense(device, matrix)
    monkeypatch.setattr(A, "defines", {"LANES": lanes})

    def twin(*arguments):
        return reference.dense_rmatvec(matrix, *arguments)

    helpers.meets_twin(A, matrix, twin, transpose=True)


@pytest.mark.parametrize("shape", [(53, 53), (200, 7), (3, 1000), (1, ROOM)])
def test_slabs_give_the_same_as_one_buffer(device, small_device, shape):
    matrix = gallery.signed(*shape)
    whole, cut = Dense(device, matrix), Dense(small_device, matrix)
    assert len(cut.slabs) == -(-shape[0] // (ROOM // shape[1]))
    for k in (None, 1, 3):
        if shape[1] * (k or 1) <= ROOM:
            x = gallery.vectors(shape[1], k)
            one, many = (A.apply(A.device.upload(x)).get() for A in (whole, cut))
            helpers.same_rows(device, one, many, reference.product_error(matrix, x))


def test_transposes_in_slabs_meet_their_twin(small_device):
    matrix = gallery.signed(90, 53)
    A = Dense(small_device, matrix)
    assert len(A.slabs) > 2
    helpers.meets_twin(A, matrix, transpose=True)


def test_row_beyond_the_largest_buffer_is_refused_with_both_sizes(small_device):
    with pytest.raises(MemoryLimitError, match=r"row 0 of the dense matrix has 3.98\d KiB.* 3\.984 KiB"):
        Dense(small_device, np.zeros((2, ROOM + 1)))


def test_memory_is_asked_before_anything_is_allocated(device, monkeypatch):
    monkeypatch.setattr(device, "memory", 1000)
    monkeypatch.setattr(Device, "empty", lambda *_: pytest.fail("allocated"))
    with pytest.raises(MemoryLimitError, match=r"\(53, 7\) needs 1.449 KiB, but .* has 1000 B"):
        Dense(device, gallery.DENSE["53x7"])


@pytest.mark.parametrize("name", gallery.DENSE)
def test_facts_about_the_entries(small_device, name):
    matrix = gallery.DENSE[name].astype(np.float64)
    A = Dense(small_device, matrix)
    assert A.nbytes == 4 * matrix.size
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    np.testing.assert_array_equal(A.to_dense(), matrix)
    helpers.norms_match(A, matrix, rel=1e-12)


@pytest.mark.parametrize(
    ("matrix", "kind", "part"),
    [
        (np.zeros(4), InputError, r"matrix has shape \(4,\); it must be \(M, N\)"),
        (np.zeros((2, 2, 2)), InputError, "it must be"),
        ([[1.0, np.nan]], InputError, r"matrix has 1 NaN or infinite value\(s\), the first at \(0, 1\)"),
        ([[1.0, 1e39]], InputError, "float32"),
        ([["a"]], InputTypeError, "must hold real numbers"),
        ([[1j]], InputTypeError, "must hold real numbers"),
    ],
)
def test_bad_matrices_are_refused(device, matrix, kind, part):
    with pytest.raises(kind, match=part):
        Dense(device, matrix)


@pytest.mark.parametrize("dtype", ["float64", "float16", "int16", "uint8", "bool"])
def test_real_numbers_of_any_type_are_taken(device, dtype):
    matrix = np.array([[1, 0], [1, 1]], dtype)
    np.testing.assert_array_equal(Dense(device, matrix) @ np.array([2, 3]), [2, 5])
