# SPDX-License-Identifier: BSD-3-Clause
"""The matrix iteration on coefficients, against dense inverses in float64."""

from __future__ import annotations

import functools
import itertools
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

from ltcl.compression import elimination, row_blocks
from ltcl.compression.iteration import invert_coefficients
from ltcl.compression.residual import Residual
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.scenes import dihedral
from ltcl.solvers import Status
from tests import gallery
from tests.problems import enclosure, lambertian

SCENES = {
    "weak": lambertian(80, 0.3, seed=1, density=0.2),
    "rho 0.8": lambertian(90, 0.8, seed=2),
    "rho 4": lambertian(70, 4.0, seed=3),
    "albedo 0.9": enclosure(65, 0.9, seed=4),
}
SIGNS = {"undo": 1.0, "add": -1.0}


invert = functools.partial(invert_coefficients, method="iteration")


def given(scene, sign) -> Any:
    """R where bounces are undone, A where they are added."""
    return scipy.sparse.csr_array(scene.R if sign > 0 else scene.A)


def off(C, D, sign):
    """||I - (I - sign D)(I + sign C)||_2 in float64."""
    eye = np.eye(C.shape[0])
    return np.linalg.norm(eye - (eye - sign * D.toarray()) @ (eye + sign * C.toarray().astype(np.float64)), 2)


@pytest.mark.parametrize("sign", SIGNS.values(), ids=SIGNS)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("rtol", [0.1, 1e-2, 1e-4])
@pytest.mark.parametrize("method", ["iteration", "elimination"])
def test_the_error_is_within_its_bound_and_the_bound_within_the_tolerance(name, sign, rtol, method):
    C = given(SCENES[name], sign)
    found = invert_coefficients(C, sign, rtol=rtol, method=method)
    assert found.method == method
    assert found.converged
    assert found.error <= rtol
    assert off(C, found.D, sign) <= found.error
    assert abs(found.D.data).min(initial=np.inf) >= found.threshold


@pytest.mark.parametrize("sign", SIGNS.values(), ids=SIGNS)
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("method", ["iteration", "elimination"])
def test_no_solution_is_off_by_more_than_the_error(name, sign, method):
    C = given(SCENES[name], sign)
    found = invert_coefficients(C, sign, rtol=0.05, method=method)
    b = gallery.vectors(C.shape[0], 20).astype(np.float64)
    x = np.linalg.solve(np.eye(len(b)) + sign * C.toarray(), b)
    wrong = np.linalg.norm(b - sign * (found.D @ b) - x, axis=0)
    assert np.all(wrong <= found.error * np.linalg.norm(x, axis=0))


def test_a_tight_tolerance_gives_the_dense_inverse():
    scene = SCENES["rho 4"]
    A = invert(given(scene, 1.0), rtol=1e-5).D
    assert abs(A - scene.A).max() < 1e-5
    R = invert(given(scene, -1.0), -1, rtol=1e-5).D
    assert np.linalg.norm(R.toarray() - scene.R, 2) < 1e-5 * np.linalg.norm(scene.S, 2)


@pytest.mark.parametrize("sign", SIGNS.values(), ids=SIGNS)
def test_spectrum_1_is_equation_21(sign):
    C = given(lambertian(40, 0.6), sign)
    found = invert(C, sign, rtol=1e-12, spectrum=(1.0, 1.0), maxiter=5, throw=False)
    X = np.eye(40)
    for _ in range(5):
        X = np.eye(40) - sign * X @ C.toarray()
    assert found.products == 5
    assert found.status is Status.MAXITER
    np.testing.assert_allclose(np.eye(40) - sign * found.D.toarray(), X, atol=1e-11)


def test_chebyshev_takes_fewer_products_and_converges_where_equation_21_diverges():
    weak, strong = given(SCENES["rho 0.8"], 1.0), given(SCENES["rho 4"], 1.0)
    series = invert(weak, rtol=1e-3, spectrum=(1.0, 1.0))
    assert invert(weak, rtol=1e-3).products <= series.products / 2
    with pytest.raises(ConvergenceError, match="the residual grew") as failed:
        invert(strong, rtol=1e-3, spectrum=(1.0, 1.0))
    assert failed.value.solution.status is Status.DIVERGED
    assert invert(strong, rtol=1e-3).converged


def test_thresholds_leave_few_numbers_of_what_is_smooth():
    A = dihedral(16, albedo=0.8).A
    W = scipy.linalg.hadamard(512) / np.sqrt(512)  # orthonormal; smooth pictures have few coefficients
    C: Any = scipy.sparse.csr_array(W @ A @ W.T)
    loose, tight = (invert(C, -1, rtol=rtol) for rtol in (3e-2, 3e-3))
    assert loose.D.nnz < tight.D.nnz < 0.5 * C.shape[0] ** 2
    S = np.linalg.inv(np.eye(512) - A)
    X = np.eye(512) + W.T @ tight.D.toarray() @ W
    assert np.linalg.norm(X - S, 2) <= tight.error * np.linalg.norm(S, 2)


def test_there_and_back():
    scene = SCENES["rho 0.8"]
    R = invert(given(scene, -1.0), -1, rtol=1e-4).D
    A = invert(R, rtol=1e-4).D
    assert np.linalg.norm(A.toarray() - scene.A, 2) < 1e-3


@pytest.mark.parametrize("fill", [1, 700])
def test_blocks_of_any_size_give_the_same_bits(fill, monkeypatch):
    C = scipy.sparse.csr_array(given(SCENES["weak"], 1.0).astype(np.float32))
    whole = invert(C, rtol=1e-3)
    monkeypatch.setattr(row_blocks, "FILL", fill)
    assert len(list(row_blocks.cuts(C))) > 5
    cut = invert(C, rtol=1e-3)
    assert whole.D.dtype == np.float32
    np.testing.assert_array_equal(whole.D.toarray(), cut.D.toarray())


def test_blocks_cover_all_rows_and_no_more_than_they_may(monkeypatch):
    C = gallery.sparse(129, 129, 0.1)
    monkeypatch.setattr(row_blocks, "FILL", 1000)
    cuts = list(row_blocks.cuts(C))
    assert cuts[0][0] == 0
    assert cuts[-1][1] == 129
    assert all(a[1] == b[0] for a, b in itertools.pairwise(cuts))
    assert all((C[a:b] @ C).nnz <= 1000 for a, b in cuts if b - a > 1)


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("method", ["iteration", "elimination"])
def test_nothing_to_invert(n, method):
    found = invert_coefficients(scipy.sparse.csr_array((n, n)), rtol=1e-3, method=method)
    assert found.converged
    assert found.D.nnz == 0
    assert found.products == 0


def test_one_pixel():
    found = invert(scipy.sparse.csr_array([[0.5]]), rtol=1e-4)
    assert found.D[0, 0] == pytest.approx(1.0 / 3.0, abs=1e-4)


def test_the_callback_sees_every_step():
    seen = []
    found = invert(given(SCENES["rho 4"], 1.0), rtol=1e-3, callback=lambda *step: seen.append(step))
    assert seen == list(enumerate(found.residuals))
    assert len(found.dropped) == found.products == len(seen) - 1


def test_the_last_step_allowed_is_not_passed():
    with pytest.raises(ConvergenceError, match="maxiter"):
        invert(given(SCENES["rho 4"], 1.0), rtol=1e-3, maxiter=2)
    found = invert(given(SCENES["rho 4"], 1.0), rtol=1e-3, maxiter=2, throw=False)
    assert found.products == 2
    assert not found.converged
    assert off(given(SCENES["rho 4"], 1.0), found.D, 1.0) <= found.error


@pytest.mark.parametrize("sign", SIGNS.values(), ids=SIGNS)
def test_the_residual_operator(sign):
    C, D = (
        gallery.sparse(53, 53, seed=1).astype(np.float64),
        gallery.sparse(53, 53, seed=2).astype(np.float64),
    )
    G = C.toarray() - D.toarray() @ (np.eye(53) + sign * C.toarray())
    X = gallery.vectors(53, 5).astype(np.float64)
    np.testing.assert_allclose(Residual(C, D, sign).matmat(X), G @ X, atol=1e-12)
    np.testing.assert_allclose(Residual(C, D, sign).rmatmat(X), G.T @ X, atol=1e-12)
    np.testing.assert_allclose(Residual(C, D, sign).matvec(X[:, 0]), G @ X[:, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("C", "options", "error", "words"),
    [
        (np.eye(2), {}, InputTypeError, "C is a ndarray"),
        (gallery.SPARSE["53x7"], {}, InputError, r"C has shape \(53, 7\); it must be square"),
        (scipy.sparse.eye_array(2), {"rtol": 0.0}, InputError, "rtol is 0.0"),
        (scipy.sparse.eye_array(2), {"rtol": 1.0}, InputError, "rtol is 1.0"),
        (scipy.sparse.eye_array(2), {"sign": 2.0}, InputError, "sign is 2.0; it must be 1 for I"),
        (scipy.sparse.eye_array(2), {"maxiter": 0}, InputError, "maxiter is 0"),
        (scipy.sparse.eye_array(2), {"callback": 3}, InputTypeError, "callback is 3"),
        (scipy.sparse.eye_array(2), {"method": "lu"}, InputError, "method is 'lu'; it must be one of auto"),
        (scipy.sparse.eye_array(2), {"spectrum": 3}, InputError, r"spectrum is 3; it must be \(lower"),
        (scipy.sparse.eye_array(2), {"spectrum": (0.0, 1.0)}, InputError, r"spectrum\[0\] is 0.0"),
        (scipy.sparse.eye_array(2), {"spectrum": (2.0, 1.0)}, InputError, r"spectrum\[1\] is 1.0"),
        (
            scipy.sparse.eye_array(2),
            {"sign": -1.0, "method": "iteration"},
            InputError,
            "an eigenvalue of real part 0",
        ),
        (scipy.sparse.eye_array(2), {"sign": -1.0, "method": "elimination"}, InputError, "I - C is singular"),
        (scipy.sparse.csr_array([[np.nan]]), {}, InputError, "NaN"),
    ],
)
def test_refusals(C, options, error, words):
    with pytest.raises(error, match=words) as refused:
        invert_coefficients(C, **options)
    assert "\n" not in str(refused.value)


def test_auto_eliminates_what_is_small_and_full_and_iterates_what_is_sparse():
    full, sparse = (
        scipy.sparse.csr_array(lambertian(200, 0.5).R),
        scipy.sparse.diags_array(np.full(5000, 0.3)),
    )
    assert elimination.pays(full)
    assert invert_coefficients(full, rtol=1e-2).method == "elimination"
    assert not elimination.pays(sparse.tocsr())
    assert invert_coefficients(sparse, rtol=1e-2).method == "iteration"
