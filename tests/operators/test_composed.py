# SPDX-License-Identifier: BSD-3-Clause
"""Operators made of others, R = T F^-1 - I of every channel among them (products are in `test_base.py`)."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    Host,
    IdentityPlus,
    ScaledColumns,
    compressed,
    interreflections,
)
from tests import gallery, reference
from tests.bases import Given, rotation, two_sided
from tests.operators import helpers

N = 33
F = np.random.default_rng(3).uniform(0.2, 0.9, (3, N))
DARK = np.where(np.arange(N) == 4, 0.0, F)  # one masked pixel
FORMS = [np.asarray, scipy.sparse.csr_array, scipy.sparse.linalg.aslinearoperator]


@pytest.mark.parametrize("sign", [1, -1])
def test_identity_and_operand_may_be_what_is_added(device, sign):
    matrix, x = gallery.signed(33, 33), gallery.vectors(33, 2)
    on_device = device.upload(x)
    product = (
        IdentityPlus(Dense(device, matrix), sign).apply(on_device, scale=0.5, add=on_device).get()
    )
    np.testing.assert_allclose(product, 0.5 * (x + sign * matrix @ x) + x, atol=1e-5)
    np.testing.assert_array_equal(on_device.get(), x)


def test_errors_of_compressed_operators_are_handed_on(device):
    A, R = (Dense(device, np.eye(5)) for _ in range(2))
    A.error = 0.25
    d, dark = np.array([1, -4, 2, 1, 1]), np.array([1, -4, 2, 0, 0])
    assert A.T.error == IdentityPlus(A).error == ScaledColumns(A, np.ones(5), 1.0).error == 0.25
    assert Compressed(A, Given(device, rotation(5)), None).error == 0.25
    assert ScaledColumns(A, dark).error == 1.0
    assert IdentityPlus(Compressed(R, None, None, 0.125)).error == 0.125
    S = IdentityPlus(A, solution_error=0.01)
    assert S.T.solution_error == S.T.T.solution_error == 0.01
    assert ScaledColumns(S, d).solution_error == 0.04
    assert ScaledColumns(S, dark).solution_error == np.inf
    assert ScaledColumns(A, dark).solution_error == 0.0


def test_host_operators_may_lack_a_transpose_and_have_a_diagonal(device, monkeypatch):
    helpers.meets_twin(Host(device, helpers.Plain(np.eye(3))), np.eye(3))
    known: dict[str, Any] = {"shape": (3, 3), "matvec": lambda x: 2.0 * x, "dtype": float}
    for parts in ({}, {"matmat": lambda x: 2.0 * x}):  # SciPy's own TypeError, for several columns
        own = scipy.sparse.linalg.LinearOperator(**known, **parts)
        with pytest.raises(InputError, match="no rmatvec"):
            Host(device, own).rmatmat(np.ones((3, 2)))
    monkeypatch.setattr(helpers.Plain, "diagonal", lambda self: [1, 2], raising=False)
    assert Host(device, helpers.Plain(np.diag([1.0, 2.0]))).diagonal().tolist() == [1.0, 2.0]


def test_unusable_numbers_and_masks_of_host_operators_are_refused(device):
    for bad, part in (
        (np.nan, "the product of Plain"),
        (np.inf, "the product of Plain"),
        (1e39, "float32"),
    ):
        with pytest.raises(InputError, match=part):
            Host(device, helpers.Plain(np.diag([bad, 1.0]))).matvec(np.ones(2))
    known: dict[str, Any] = {"shape": (2, 2), "matvec": lambda x: x, "dtype": float}
    known["matmat"] = lambda X: np.ma.masked_less(X, 0.5)
    A = Host(device, scipy.sparse.linalg.LinearOperator(**known))
    with pytest.raises(InputTypeError, match=r"the product of .*1 masked"):
        A.matmat(np.array([[0.0, 1.0], [1.0, 1.0]]))


def test_threads_share_an_operator(device):
    R = two_sided(device, gallery.bounces(N, 0.5))
    pictures = [gallery.vectors(N, 1 + seed % 3, seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        for x, product in zip(pictures, pool.map(R.matmat, pictures), strict=True):
            helpers.same_bits(product, R.matmat(x))


def test_a_diagonal_of_many_pixels_has_to_be_told(device, monkeypatch):
    monkeypatch.setattr(compressed, "MAX_DIAGONAL_PRODUCTS", N - 1)
    R = two_sided(device, gallery.bounces(N, 0.5))
    with pytest.raises(InputError, match=rf"{N} pixels.*diagonal="):
        R.diagonal()
    told = Compressed(R.core, R.out, R.into, diagonal=np.arange(N))
    assert told.diagonal().tolist() == list(range(N))
    assert (
        len(Compressed(Dense(device, np.eye(N)), None, None).diagonal()) == N
    )  # of pixels, at hand


def test_sides_and_bytes_of_compressed_operators(device):
    W, V = Given(device, rotation(N)), Given(device, rotation(N, 1))
    tall, core = Given(device, gallery.signed(N + 12, N, 2) / 4), Dense(device, np.eye(N))
    assert Compressed(core, W, W).two_sided
    for sides in ((None, None), (W, None), (None, W), (W, V)):
        assert not Compressed(core, *sides).two_sided
    assert not Compressed(Dense(device, np.eye(N + 12)), tall, tall).two_sided
    assert Compressed(core, W, W).nbytes == core.nbytes + W.nbytes
    assert Compressed(core, W, V).nbytes == core.nbytes + 2 * W.nbytes


def transport(channel: int, density: float = 0.4) -> np.ndarray:
    """Places are alike in all channels; the diagonal is full."""
    T = np.abs(gallery.sparse(N, N, density).toarray().astype(np.float64)) * (channel + 1)
    T[np.diag_indices(N)] += 0.1
    return T


def expected(T: np.ndarray, f: np.ndarray) -> np.ndarray:
    return T * np.divide(1.0, f, out=np.zeros(N), where=f > 0) - np.diag(f > 0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("diagonal", ["lit", "masked", "first bounce", "none"])
def test_interreflections_of_all_forms_agree(device, form, diagonal):
    matrices, first_bounce = [transport(channel) for channel in range(3)], F
    if diagonal == "masked":
        first_bounce = DARK
    elif diagonal == "first bounce":  # F = diag(T): R has no diagonal at all
        first_bounce = np.array([T.diagonal() for T in matrices])
    elif diagonal == "none":  # F is given where T stores nothing
        matrices = [T - np.diag(T.diagonal()) for T in matrices]
    systems = interreflections([form(T) for T in matrices], first_bounce, device)
    for S, T, f in zip(systems, matrices, first_bounce, strict=True):
        R, x = expected(T, f), gallery.vectors(N, None)
        helpers.meets_twin(S.R, R)
        helpers.close(
            S.matvec(x), x + R @ x, reference.product_error(np.eye(N) + np.abs(R), np.abs(x))
        )
        if isinstance(S.R, CSR):
            assert S.R.pattern is getattr(systems[0].R, "pattern", None)
            assert diagonal != "first bounce" or S.R.nnz == np.count_nonzero(T) - N


def test_channels_of_another_pattern_keep_their_own(device):
    sparse = [scipy.sparse.csr_array(transport(0, density)) for density in (0.2, 0.4)]
    red, green = (S.R for S in interreflections(sparse, F[:2], device))
    assert isinstance(red, CSR)
    assert isinstance(green, CSR)
    assert red.pattern is not green.pattern


def test_it_brings_the_weights_that_make_it_self_adjoint(device):
    """Of a symmetric T: <S x, y> = <x, S y> with weights 1 / F; of a masked one nothing is known."""
    T = [transport(c) + transport(c).T for c in range(3)]
    for S, f, t in zip(interreflections(T, F, device), F, T, strict=True):
        assert S.weights is not None
        np.testing.assert_allclose(S.weights, 1.0 / f)
        weighted = np.diag(1.0 / f) @ t @ np.diag(1.0 / f)
        np.testing.assert_allclose(S.weights[:, None] * S.to_dense(), weighted, rtol=1e-5)
    assert all(S.weights is None for S in interreflections(T, DARK, device))
