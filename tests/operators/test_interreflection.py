# SPDX-License-Identifier: BSD-3-Clause
"""R = T F^-1 - I of every channel."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from ltcl.operators import CSR, IdentityPlus, interreflections
from tests import gallery, reference
from tests.operators import helpers

N = 33
F = np.random.default_rng(3).uniform(0.2, 0.9, (3, N))
DARK = np.where(np.arange(N) == 4, 0.0, F)  # one masked pixel


def transport(channel: int, density: float = 0.4) -> np.ndarray:
    """Places are alike in all channels; the diagonal is full."""
    T = np.abs(gallery.sparse(N, N, density).toarray().astype(np.float64)) * (channel + 1)
    T[np.diag_indices(N)] += 0.1
    return T


def expected(T: np.ndarray, f: np.ndarray) -> np.ndarray:
    inverse = np.divide(1.0, f, out=np.zeros(N), where=f > 0)
    return T * inverse - np.diag(f > 0)


def csr(S: IdentityPlus) -> CSR:
    assert isinstance(S.R, CSR)
    return S.R


FORMS = [np.asarray, scipy.sparse.csr_array, scipy.sparse.linalg.aslinearoperator]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("first_bounce", [F, DARK], ids=["lit", "masked"])
def test_interreflections_of_all_forms_agree(device, form, first_bounce):
    matrices = [transport(channel) for channel in range(3)]
    systems = interreflections([form(T) for T in matrices], first_bounce, device)
    for S, T, f in zip(systems, matrices, first_bounce, strict=True):
        R = expected(T, f)
        helpers.meets_twin(S.R, R)
        x = gallery.vectors(N, None)
        helpers.close(S.matvec(x), x + R @ x, reference.product_error(np.eye(N) + np.abs(R), np.abs(x)))


@pytest.mark.parametrize("diagonal", ["measured", "first bounce", "none"])
def test_channels_share_their_pattern(device, diagonal):
    matrices = [transport(channel) for channel in range(3)]
    first_bounce = F
    if diagonal == "first bounce":  # F = diag(T): R has no diagonal at all
        first_bounce = np.array([T.diagonal() for T in matrices])
    if diagonal == "none":  # F is given where T stores nothing
        for T in matrices:
            np.fill_diagonal(T, 0)
    sparse = [scipy.sparse.csr_array(T) for T in matrices]
    operators = [csr(S) for S in interreflections(sparse, first_bounce, device)]
    assert all(R.pattern is operators[0].pattern for R in operators)
    for R, T, f in zip(operators, matrices, first_bounce, strict=True):
        helpers.meets_twin(R, expected(T, f))
    if diagonal == "first bounce":
        assert operators[0].nnz == sparse[0].nnz - N


def test_channels_of_another_pattern_keep_their_own(device):
    sparse = [scipy.sparse.csr_array(transport(0, density)) for density in (0.2, 0.4)]
    red, green = (csr(S) for S in interreflections(sparse, F[:2], device))
    assert red.pattern is not green.pattern


def test_it_brings_the_weights_that_make_it_self_adjoint(device):
    """Of a symmetric T: <S x, y> = <x, S y> with weights 1 / F; of a masked one nothing is known."""
    T = [transport(c) + transport(c).T for c in range(3)]
    for S, f, t in zip(interreflections(T, F, device), F, T, strict=True):
        assert S.weights is not None
        np.testing.assert_allclose(S.weights, 1.0 / f)
        weighted = np.diag(1.0 / f) @ t @ np.diag(1.0 / f)
        np.testing.assert_allclose(S.weights[:, None] * S.to_dense(), weighted, rtol=1e-5)
        np.testing.assert_allclose(weighted, weighted.T, rtol=1e-12)
    assert all(S.weights is None for S in interreflections(T, DARK, device))
