# SPDX-License-Identifier: BSD-3-Clause
"""The matrix iteration on coefficients, against dense inverses in float64."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

from ltcl.compression import invert_coefficients
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.scenes import dihedral
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


def test_thresholds_leave_few_numbers_of_what_is_smooth():
    A = dihedral(16, albedo=0.8).A
    W = scipy.linalg.hadamard(512) / np.sqrt(512)  # orthonormal; smooth pictures have few coefficients
    C: Any = scipy.sparse.csr_array(W @ A @ W.T)
    loose, tight = (invert(C, -1, rtol=rtol) for rtol in (3e-2, 3e-3))
    assert loose.D.nnz < tight.D.nnz < 0.5 * C.shape[0] ** 2
    S = np.linalg.inv(np.eye(512) - A)
    X = np.eye(512) + W.T @ tight.D.toarray() @ W
    assert np.linalg.norm(X - S, 2) <= tight.error * np.linalg.norm(S, 2)


@pytest.mark.parametrize("n", [1, 7])
@pytest.mark.parametrize("method", ["iteration", "elimination"])
def test_nothing_to_invert(n, method):
    found = invert_coefficients(scipy.sparse.csr_array((n, n)), rtol=1e-3, method=method)
    assert found.converged
    assert found.D.nnz == 0
    assert found.products == 0


def test_the_last_step_allowed_is_not_passed():
    with pytest.raises(ConvergenceError, match="maxiter") as failed:
        invert(given(SCENES["rho 4"], 1.0), rtol=1e-3, maxiter=2)
    found = failed.value.solution
    assert found.products == 2
    assert not found.converged
    assert off(given(SCENES["rho 4"], 1.0), found.D, 1.0) <= found.error


@pytest.mark.parametrize(
    ("C", "options", "error", "words"),
    [
        (np.eye(2), {}, InputTypeError, "C is a ndarray"),
        (gallery.SPARSE["53x7"], {}, InputError, r"C has shape \(53, 7\)"),
        (scipy.sparse.eye_array(2), {"rtol": 0.0}, InputError, "rtol is 0.0"),
        (scipy.sparse.eye_array(2), {"rtol": 1.0}, InputError, "rtol is 1.0"),
        (scipy.sparse.eye_array(2), {"sign": 2.0}, InputError, "sign is 2.0"),
        (scipy.sparse.eye_array(2), {"maxiter": 0}, InputError, "maxiter is 0"),
        (scipy.sparse.eye_array(2), {"method": "lu"}, InputError, "method is 'lu'"),
        (
            scipy.sparse.eye_array(2),
            {"sign": -1.0, "method": "iteration"},
            InputError,
            "eigenvalue.* 0",
        ),
        (scipy.sparse.eye_array(2), {"sign": -1.0, "method": "elimination"}, InputError, "singular"),
        (scipy.sparse.csr_array([[np.nan]]), {}, InputError, "NaN"),
    ],
)
def test_refusals(C, options, error, words):
    with pytest.raises(error, match=words) as refused:
        invert_coefficients(C, **options)
    assert "\n" not in str(refused.value)


def test_auto_eliminates_what_is_full_and_iterates_what_is_sparse():
    full = scipy.sparse.csr_array(lambertian(200, 0.5).R)
    assert invert_coefficients(full, rtol=1e-2).method == "elimination"
    sparse = scipy.sparse.diags_array(np.full(5000, 0.3))
    assert invert_coefficients(sparse, rtol=1e-2).method == "iteration"
