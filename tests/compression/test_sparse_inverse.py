# SPDX-License-Identifier: BSD-3-Clause
"""The matrix iteration on coefficients, and elimination, against dense inverses in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.compression import invert_coefficients
from ltcl.errors import ConvergenceError, InputError, InputTypeError
from ltcl.scenes import dihedral
from ltcl.solvers import Status
from tests import gallery
from tests.problems import enclosure, lambertian

SCENES = {
    "weak": lambertian(30, 0.3, seed=1, density=0.2),
    "rho 0.8": lambertian(27, 0.8, seed=2),
    "rho 4": lambertian(29, 4.0, seed=3),
    "albedo 0.9": enclosure(25, 0.9, seed=4),
}
ROOMS = {"iteration": 20, "elimination": 1}  # that do not see each other: many make a sparse matrix


def without_room(monkeypatch):
    """A host without memory for elimination."""
    monkeypatch.setattr(checks, "host_memory", lambda: 0)


def rooms(matrix, method) -> Any:
    return scipy.sparse.csr_array(scipy.sparse.block_diag([matrix] * ROOMS[method]))


def relative_error(C, D):
    """||I - (I - D)(I + C)||_2 in float64."""
    eye = np.eye(C.shape[0])
    return np.linalg.norm(eye - (eye - D.toarray()) @ (eye + C.toarray().astype(np.float64)), 2)


@pytest.mark.parametrize("undo", [True, False])
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("rtol", [0.1, 1e-4])
@pytest.mark.parametrize("method", ROOMS)
def test_the_error_is_within_its_bound_and_the_bound_within_the_tolerance(name, undo, rtol, method):
    C = rooms(SCENES[name].R if undo else -SCENES[name].A, method)
    inverse = invert_coefficients(C, rtol=rtol)
    assert inverse.method == method
    assert inverse.status is Status.CONVERGED
    assert relative_error(C, inverse.D) <= inverse.error <= rtol


def test_thresholds_leave_few_numbers_of_what_is_smooth(monkeypatch):
    A = dihedral(16, albedo=0.8).A
    without_room(monkeypatch)
    W = scipy.linalg.hadamard(512) / np.sqrt(512)  # orthonormal; smooth pictures have few coefficients
    C: Any = scipy.sparse.csr_array(-W @ A @ W.T)
    loose, tight = (invert_coefficients(C, rtol=rtol) for rtol in (3e-2, 3e-3))
    assert loose.method == tight.method == "iteration"
    assert loose.D.nnz < tight.D.nnz < 0.5 * C.shape[0] ** 2
    assert relative_error(C, tight.D) <= tight.error


@pytest.mark.parametrize("n", [1, 99])
def test_nothing_to_invert(n):
    inverse = invert_coefficients(scipy.sparse.csr_array((n, n)), rtol=1e-3)
    assert (inverse.status, inverse.D.nnz, inverse.products) == (Status.CONVERGED, 0, 0)


def test_what_takes_too_many_products_is_refused_with_what_there_is(monkeypatch):
    C = rooms(-enclosure(25, 0.998).A, "iteration")
    without_room(monkeypatch)
    with pytest.raises(ConvergenceError, match="loosen rtol") as failed:
        invert_coefficients(C, rtol=1e-3)
    inverse = failed.value.solution
    assert inverse.status is Status.MAXITER
    assert relative_error(C, inverse.D) <= inverse.error


@pytest.mark.parametrize(
    ("C", "options", "error", "words"),
    [
        (np.eye(2), {}, InputTypeError, "C is a ndarray"),
        (gallery.SPARSE["53x7"], {}, InputError, r"C has shape \(53, 7\)"),
        (scipy.sparse.eye_array(2), {"rtol": 0.0}, InputError, "rtol is 0.0"),
        (scipy.sparse.eye_array(2), {"rtol": 1.0}, InputError, "rtol is 1.0"),
        (-scipy.sparse.eye_array(2), {}, InputError, "singular"),
        (scipy.sparse.csr_array([[np.nan]]), {}, InputError, "NaN"),
    ],
)
def test_refusals(C, options, error, words):
    with pytest.raises(error, match=words) as refused:
        invert_coefficients(C, **options)
    assert "\n" not in str(refused.value)


def test_eigenvalues_of_no_scene_are_eliminated_where_there_is_room(monkeypatch):
    C = rooms(-1.5 * np.eye(20), "iteration")
    inverse = invert_coefficients(C, rtol=1e-2)
    assert inverse.method == "elimination"
    assert relative_error(C, inverse.D) <= inverse.error <= 1e-2
    without_room(monkeypatch)
    with pytest.raises(InputError, match=r"eigenvalue.* -0\.5"):
        invert_coefficients(C)
