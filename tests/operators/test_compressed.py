# SPDX-License-Identifier: BSD-3-Clause
"""Operators between bases: errors, diagonals, memory, threads; products are in `test_base.py`."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.operators import Compressed, Dense, IdentityPlus, ScaledColumns, compressed
from tests import gallery
from tests.bases import MatrixBasis, rotation, two_sided
from tests.operators import helpers

N = 33


@pytest.mark.parametrize("sign", [1, -1])
def test_identity_and_operand_may_be_what_is_added(device, sign):
    matrix = gallery.signed(33, 33)
    x = gallery.vectors(33, 2)
    on_device = device.upload(x)
    S = IdentityPlus(Dense(device, matrix), sign)
    product = S.apply(on_device, scale=0.5, add=on_device).get()
    np.testing.assert_allclose(product, 0.5 * (x + sign * matrix @ x) + x, atol=1e-5)
    np.testing.assert_array_equal(on_device.get(), x)


def test_errors_of_compressed_operators_are_handed_on(device):
    A = Dense(device, np.eye(5))
    A.error = 0.25
    R = Dense(device, np.eye(5))
    d = np.array([1, -4, 2, 1, 1])
    masked = np.array([1, -4, 2, 0, 0])
    assert A.T.error == 0.25
    assert IdentityPlus(A).error == 0.25
    assert ScaledColumns(A, np.ones(5), 1.0).error == 0.25
    assert Compressed(A, MatrixBasis(device, rotation(5)), None).error == 0.25
    assert ScaledColumns(A, masked).error == 1.0
    assert IdentityPlus(Compressed(R, None, None, 0.125)).error == 0.125
    S = IdentityPlus(A, solution_error=0.01)
    assert S.T.solution_error == 0.01
    assert S.T.T.solution_error == 0.01
    assert ScaledColumns(S, d).solution_error == 0.04
    assert ScaledColumns(S, masked).solution_error == np.inf
    assert ScaledColumns(A, masked).solution_error == 0.0


@pytest.mark.slow
def test_threads_share_an_operator(device):
    R = two_sided(device, gallery.bounces(N, 0.5))
    pictures = [gallery.vectors(N, 1 + seed % 3, seed) for seed in range(8)]
    with ThreadPoolExecutor(4) as pool:
        products = list(pool.map(R.matmat, pictures))
    for picture, product in zip(pictures, products, strict=True):
        helpers.same_bits(product, R.matmat(picture))


def test_a_diagonal_of_many_pixels_has_to_be_given(device, monkeypatch):
    monkeypatch.setattr(compressed, "MAX_DIAGONAL_PRODUCTS", N - 1)
    R = two_sided(device, gallery.bounces(N, 0.5))
    with pytest.raises(InputError, match=rf"{N} pixels.*diagonal="):
        R.diagonal()
    with_diagonal = Compressed(R.core, R.out, R.into, diagonal=np.arange(N))
    assert with_diagonal.diagonal().tolist() == list(range(N))
    # Between pixels the core has it.
    in_pixels = Compressed(Dense(device, np.eye(N)), None, None)
    assert len(in_pixels.diagonal()) == N


def test_sides_and_bytes_of_compressed_operators(device):
    W = MatrixBasis(device, rotation(N))
    V = MatrixBasis(device, rotation(N, 1))
    core = Dense(device, np.eye(N))
    assert Compressed(core, W, W).two_sided
    for sides in ((None, None), (W, None), (None, W), (W, V)):
        assert not Compressed(core, *sides).two_sided
    tall = MatrixBasis(device, gallery.signed(N + 12, N, 2) / 4)
    assert not Compressed(Dense(device, np.eye(N + 12)), tall, tall).two_sided
    assert Compressed(core, W, W).nbytes == core.nbytes + W.nbytes
    assert Compressed(core, W, V).nbytes == core.nbytes + 2 * W.nbytes


def test_systems_between_coefficients(device):
    R = two_sided(device, gallery.bounces(N, 0.5))
    S = IdentityPlus(R, -1, weights=np.ones(N))
    assert S.coefficient_basis is R.into
    system = S.on_coefficients()
    np.testing.assert_allclose(system.to_dense(), np.eye(N) - R.core.to_dense(), atol=1e-6)
    # What is learnt of the system serves all solves; row sums in pixels bound its spectrum.
    assert S.on_coefficients() is system
    assert system.row_sums() is S.row_sums()
    for other in (Compressed(R.core, R.out, None), R.core):
        assert IdentityPlus(other).coefficient_basis is None
        with pytest.raises(InputError, match="one basis"):
            IdentityPlus(other).on_coefficients()
