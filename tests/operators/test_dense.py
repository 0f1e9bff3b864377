# SPDX-License-Identifier: BSD-3-Clause
"""Dense matrices on the device: transposes in the shapes of CPUs and GPUs, what is taken and refused."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Dense
from tests import gallery, reference
from tests.operators import helpers


@pytest.mark.parametrize("name", gallery.DENSE)
@pytest.mark.parametrize("lanes", [1, 8])
def test_transposes_meet_their_twin(device, monkeypatch, name, lanes):
    matrix = gallery.DENSE[name]
    A = Dense(device, matrix)
    monkeypatch.setattr(A, "defines", {"LANES": lanes})

    def twin(*arguments):
        return reference.dense_rmatvec(matrix, *arguments)

    helpers.meets_twin(A, matrix, twin, transpose=True)


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
