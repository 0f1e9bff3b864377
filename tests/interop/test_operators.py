# SPDX-License-Identifier: BSD-3-Clause
"""Operators of SciPy and PyLops, in ltcl and from it; no warning comes out."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import scipy
import scipy.sparse.linalg

import ltcl
from ltcl.errors import InputTypeError
from tests.interop.calls import GRID, picture, transport

pytestmark = [pytest.mark.usefixtures("device"), pytest.mark.filterwarnings("error")]
HAS_BATCHES = tuple(map(int, scipy.__version__.split(".")[:2])) >= (1, 18)
X = picture(32, seed=2)


def exact() -> np.ndarray:
    return transport().interreflection.to_dense()


def test_scipy_solves_with_an_operator():
    S = transport().interreflection
    x, failed = scipy.sparse.linalg.gmres(S, X, rtol=1e-6)
    assert not failed
    np.testing.assert_allclose(exact() @ x, X, rtol=1e-4)
    largest: Any = scipy.sparse.linalg.svds(S, k=1, return_singular_vectors=False)
    np.testing.assert_allclose(largest, np.linalg.norm(exact(), 2), rtol=1e-5)


def test_operators_of_scipy_join_with_those_of_ltcl():
    S = transport().interreflection
    other = scipy.sparse.linalg.aslinearoperator(np.diag(X))
    for joined, matrix in (
        (S + other, exact() + np.diag(X)),
        (S @ other, exact() * X),
        ((2.0 * S).T, 2.0 * exact().T),
        (S**2, exact() @ exact()),
    ):
        np.testing.assert_allclose(joined @ X, matrix @ X, rtol=1e-5)
    np.testing.assert_allclose(X @ S, X @ exact(), rtol=1e-5)


def test_ltcl_solves_with_an_operator_of_scipy():
    S = scipy.sparse.linalg.aslinearoperator(exact())
    solution = ltcl.solve(S, X, "gmres", rtol=1e-5)
    np.testing.assert_allclose(exact() @ solution.x, X, rtol=1e-4)
    T = ltcl.Transport(
        scipy.sparse.linalg.aslinearoperator(transport().to_numpy()),
        GRID,
        first_bounce=transport().first_bounce,
    )
    np.testing.assert_allclose(T @ picture(), transport() @ picture(), rtol=1e-5)


def test_pylops_both_ways():
    import pylops

    S: Any = pylops.aslinearoperator(transport().interreflection)
    assert isinstance(S, pylops.LinearOperator)
    smooth: Any = pylops.Laplacian(dims=GRID, dtype="float32")
    normal: Any = S.T @ (S @ X)
    np.testing.assert_allclose(normal, exact().T @ exact() @ X, rtol=1e-4)
    assert np.isfinite((smooth @ S) @ X).all()
    solution = ltcl.solve(pylops.MatrixMult(exact()), X, "gmres", rtol=1e-5)
    np.testing.assert_allclose(exact() @ solution.x, X, rtol=1e-4)
    T = ltcl.Transport(
        pylops.MatrixMult(transport().to_numpy()), GRID, first_bounce=transport().first_bounce
    )
    expected = ltcl.compensate(transport(), picture(), rtol=1e-5).pattern
    np.testing.assert_allclose(
        ltcl.compensate(T, picture(), rtol=1e-5).pattern, expected, atol=1e-3
    )


def test_masked_operands_are_refused():
    with pytest.raises(InputTypeError, match="masked"):
        transport().interreflection.dot(np.ma.masked_less(X, 0.1))


BATCHES = """
import warnings
warnings.simplefilter("error")
import numpy as np
import scipy.sparse.linalg
import ltcl
from tests.interop.calls import transport

S = transport().interreflection
D = S.to_dense()
random = np.random.default_rng(0)
X = random.random((2, 3, 32, 4))
x = random.random((2, 3, 32))
np.testing.assert_allclose(S @ X, D @ X, rtol=1e-4)
np.testing.assert_allclose(S.matmat(X), D @ X, rtol=1e-4)
np.testing.assert_allclose(S.rmatmat(X), D.T @ X, rtol=1e-4)
np.testing.assert_allclose(S.matvec(x), x @ D.T, rtol=1e-4)
np.testing.assert_allclose(S.rmatvec(x), x @ D, rtol=1e-4)
np.testing.assert_allclose(x @ S, x @ D, rtol=1e-4)
# The three columns of one picture are no vector: nothing in ltcl asks SciPy for that.
assert ltcl.solve(scipy.sparse.linalg.aslinearoperator(D), X[0, 0, :, :1], "gmres").converged
"""
ARRAY_API = """
import array_api_strict
o = scipy.sparse.linalg.aslinearoperator(array_api_strict.asarray(D))
solution = ltcl.solve(o, x[0, 0], "gmres", rtol=1e-5)
np.testing.assert_allclose(D @ solution.x, x[0, 0], rtol=1e-3)
product = S @ array_api_strict.asarray(X)
np.testing.assert_allclose(np.from_dlpack(product), D @ X, rtol=1e-4)
"""


@pytest.mark.skipif(
    not HAS_BATCHES,
    reason="SciPy is older than 1.18, whose operators take batches (from Python 3.12 on)",
)
@pytest.mark.parametrize("namespaces", ["", "1"])
def test_batches_and_other_namespaces(namespaces):
    """In a process of its own: SciPy looks at this variable once."""
    environment = {**os.environ, "SCIPY_ARRAY_API": namespaces}
    code = BATCHES + (ARRAY_API if namespaces else "")
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert run.returncode == 0, run.stderr
