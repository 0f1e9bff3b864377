# SPDX-License-Identifier: BSD-3-Clause
"""Fingerprints of matrices change with any entry, and do not depend on how a matrix is stored."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

from ltcl.transport.fingerprint import fingerprint

random = np.random.default_rng()


@pytest.mark.parametrize(
    "kind", [np.array, scipy.sparse.csr_array, scipy.sparse.coo_array, aslinearoperator]
)
def test_fingerprints_change_with_any_entry(kind: Any) -> None:
    T = random.random((5, 4))
    changed = T.copy()
    changed[2, 3] += 0.1
    assert fingerprint(kind(T)) == fingerprint(kind(T.copy())) != fingerprint(kind(changed))
    assert fingerprint(scipy.sparse.csr_array(T)) == fingerprint(scipy.sparse.csc_array(T))
