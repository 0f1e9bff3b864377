# SPDX-License-Identifier: BSD-3-Clause
"""Matrices made entry by entry from others, in both formats and across slabs."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, Host, IdentityPlus
from ltcl.operators.entrywise import mapped, rows_of_R, squares
from tests import gallery

FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
R = gallery.sparse(53, 53, 0.4).toarray()


@pytest.mark.parametrize("form", FORMATS)
def test_entries_are_mapped_one_by_one(small_device, form):
    M = FORMATS[form](small_device, R)
    assert len(M.slabs) > 1
    np.testing.assert_array_equal(mapped(M, np.abs).to_dense(), np.abs(R))
    np.testing.assert_array_equal(squares(M).to_dense(), np.square(R))
    np.testing.assert_array_equal(M.to_dense(), R)
    assert squares(M) is squares(M)


@pytest.mark.parametrize("form", FORMATS)
def test_R_is_what_S_has_beside_the_identity(device, form):
    M = FORMATS[form](device, R)
    assert rows_of_R(IdentityPlus(M), "monte_carlo") == (M, 1.0)
    assert rows_of_R(IdentityPlus(M, -1), "monte_carlo") == (M, -1.0)
    made, sign = rows_of_R(FORMATS[form](device, np.eye(53, dtype=np.float32) + R), "monte_carlo")
    assert sign == 1.0
    np.testing.assert_allclose(made.to_dense(), R, rtol=0, atol=1e-7)


def test_R_of_a_stored_S_is_made_once(device):
    S = Dense(device, np.eye(5))
    assert rows_of_R(S, "hybrid")[0] is rows_of_R(S, "hybrid")[0]


def test_operators_without_rows_are_refused(device):
    with pytest.raises(InputError, match="method='hybrid' reads S row by row, which Host does not allow"):
        rows_of_R(IdentityPlus(Host(device, scipy.sparse.linalg.aslinearoperator(R))), "hybrid")
