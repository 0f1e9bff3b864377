# SPDX-License-Identifier: BSD-3-Clause
"""R = T F^-1 - I of every channel, from T in every form."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from ltcl.operators import CSR, interreflections
from tests import gallery, reference
from tests.operators import helpers

N = 33
F = np.random.default_rng(3).uniform(0.2, 0.9, (3, N))
# One pixel is masked.
MASKED = np.where(np.arange(N) == 4, 0.0, F)
FORMS = [np.asarray, scipy.sparse.csr_array, scipy.sparse.linalg.aslinearoperator]


def transport(channel: int, density: float = 0.4) -> np.ndarray:
    """Places are alike in all channels; the diagonal is full."""
    T = np.abs(gallery.sparse(N, N, density).toarray().astype(np.float64)) * (channel + 1)
    T[np.diag_indices(N)] += 0.1
    return T


def expected(T: np.ndarray, f: np.ndarray) -> np.ndarray:
    inverse = np.divide(1.0, f, out=np.zeros(N), where=f > 0)
    return T * inverse - np.diag(f > 0)


def scene(diagonal: str) -> tuple[list[np.ndarray], np.ndarray]:
    """T of three channels and their first bounces."""
    matrices = [transport(channel) for channel in range(3)]
    if diagonal == "masked":
        return matrices, MASKED
    if diagonal == "first bounce":
        # F = diag(T): R has no diagonal at all.
        return matrices, np.array([T.diagonal() for T in matrices])
    if diagonal == "none":
        # F is given where T stores nothing.
        return [T - np.diag(T.diagonal()) for T in matrices], F
    return matrices, F


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("diagonal", ["lit", "masked", "first bounce", "none"])
def test_interreflections_of_all_forms_agree(device, form, diagonal):
    matrices, first_bounce = scene(diagonal)
    systems = interreflections([form(T) for T in matrices], first_bounce, device)
    x = gallery.vectors(N, None)
    for S, T, f in zip(systems, matrices, first_bounce, strict=True):
        R = expected(T, f)
        helpers.meets_twin(S.R, R)
        error = reference.product_error(np.eye(N) + np.abs(R), np.abs(x))
        helpers.close(S.matvec(x), x + R @ x, error)
        if isinstance(S.R, CSR):
            assert S.R.pattern is getattr(systems[0].R, "pattern", None)
            assert diagonal != "first bounce" or S.R.nnz == np.count_nonzero(T) - N


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("diagonal", ["lit", "masked"])
def test_float64_products_are_those_of_T(device, form, diagonal):
    """R in float32 is rounded; the numbers of T are not, in T as it was given."""
    matrices, first_bounce = scene(diagonal)
    systems = interreflections([form(T) for T in matrices], first_bounce, device)
    x = gallery.vectors(N, 2).astype(np.float64)
    for S, T, f in zip(systems, matrices, first_bounce, strict=True):
        exact = np.eye(N) + expected(T, f)
        product = S.product_float64()
        assert product is not None
        dense, is_given = S.matrix_float64()
        assert is_given
        # A sparse R is kept on the host as it was computed.
        np.testing.assert_allclose(product(x), exact @ x, rtol=0, atol=1e-12)
        np.testing.assert_allclose(dense, exact, rtol=0, atol=1e-12)


def test_channels_of_another_pattern_keep_their_own(device):
    sparse = [scipy.sparse.csr_array(transport(0, density)) for density in (0.2, 0.4)]
    red, green = (S.R for S in interreflections(sparse, F[:2], device))
    assert isinstance(red, CSR)
    assert isinstance(green, CSR)
    assert red.pattern is not green.pattern


def test_weights_make_it_self_adjoint(device):
    """If T is symmetric, <S x, y> = <x, S y> with weights 1 / F; with masked pixels unknown."""
    T = [transport(c) + transport(c).T for c in range(3)]
    for S, f, t in zip(interreflections(T, F, device), F, T, strict=True):
        assert S.weights is not None
        np.testing.assert_allclose(S.weights, 1.0 / f)
        weighted = np.diag(1.0 / f) @ t @ np.diag(1.0 / f)
        np.testing.assert_allclose(S.weights[:, None] * S.to_dense(), weighted, rtol=1e-5)
    for S in interreflections(T, MASKED, device):
        assert S.weights is None
