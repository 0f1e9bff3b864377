# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl.invert`, and the iteration and elimination behind it, against dense inverses in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl import checks
from ltcl.errors import ConvergenceError, InputError, InputTypeError, ToleranceError
from ltcl.operators import Compressed, Dense, IdentityPlus, Operator, ScaledColumns, Wavelet
from ltcl.solvers import Status
from ltcl.tasks.compression import invert_coefficients
from tests import gallery
from tests.operators.helpers import FORMATS
from tests.problems import enclosure, lambertian

GRID = (5, 6)
N = 30
random = np.random.default_rng(5)
SCENES = {
    "weak": lambertian(N, 0.3, seed=1, density=0.2),
    "rho 0.8": lambertian(N, 0.8, seed=2),
    "rho 4": lambertian(N, 4.0, seed=3),
    "albedo 0.9": enclosure(N, 0.9, seed=4),
}
ROOMS = {"iteration": 20, "elimination": 1}  # that do not see each other: many make a sparse matrix


def transport(scene, **options):
    return ltcl.Transport(scene.T, GRID, first_bounce=scene.F, **options)


def relative_error(A, S):
    """||I - (I - A~) S||_2 in float64: the largest relative error of a solution there is."""
    eye = np.eye(len(S))
    return np.linalg.norm(eye - (eye - A) @ S, 2)


def error_of(inverse, S, channel=0):
    return relative_error(inverse.systems[channel].R.to_dense(), S)


@pytest.fixture(scope="module")
def smooth():
    scene = ltcl.scenes.dihedral(8, albedo=0.8)
    T = scene.transport(first_bounce=scene.first_bounce)
    return T, ltcl.invert(T, 1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("basis", ["db2", "pixels"])
@pytest.mark.parametrize("rtol", [0.1, 1e-3])
@pytest.mark.parametrize("name", SCENES)
def test_the_error_is_a_bound_and_within_the_tolerance(name, rtol, basis):
    scene = SCENES[name]
    inverse = ltcl.invert(transport(scene), rtol, basis=basis)
    assert error_of(inverse, scene.S) <= inverse.error <= rtol
    A = inverse.systems[0].R
    assert np.linalg.norm(A.to_dense() - scene.A, 2) <= A.error


@pytest.mark.rare
@pytest.mark.parametrize("forms", [(None,) * 3, ("db2", "db2 rows", "haar")])
def test_colours_have_their_own(forms):
    """Channels that were compressed in several forms are written in one basis."""
    scenes = [lambertian(N, rho, seed=7) for rho in (0.2, 0.8, 2.0)]
    matrices = []
    for one, basis in zip(map(transport, scenes), forms, strict=True):
        matrices += (ltcl.compress(one, 0.01, norm="worst", basis=basis) if basis else one).matrices
    T = ltcl.Transport(matrices, GRID, first_bounce=np.stack([scene.F for scene in scenes]))
    inverse = ltcl.invert(T, 0.05)
    assert inverse.channels == 3
    for channel, scene in enumerate(scenes):
        assert (
            error_of(inverse, scene.S, channel) <= inverse.errors[channel] <= inverse.error <= 0.05
        )
    desired = random.uniform(0.2, 0.3, (*GRID, 3))
    c = ltcl.compensate(T, desired, bounds=(-10, 10), inverse=inverse)
    assert isinstance(c.solution, tuple)
    assert [s.products for s in c.solution] == [1, 1, 1]
    assert c.error <= 0.1


@pytest.mark.slow
def test_clamping_is_quick_and_says_what_it_costs(smooth):
    T, inverse = smooth
    desired = random.uniform(0.0, 1.0, T.grid)
    clamped = ltcl.compensate(T, desired, inverse=inverse, clamp=True)
    best = ltcl.compensate(T, desired, inverse=inverse)
    light = np.linalg.solve(T.systems[0].to_dense(), desired.ravel()) / T.first_bounce
    assert clamped.limited == ()
    assert clamped.error >= best.error - best.gap
    assert clamped.gap == clamped.error
    assert clamped.clipped == pytest.approx(np.mean((light < 0) | (light > 1)), abs=0.02)
    np.testing.assert_allclose(clamped.pattern.ravel(), np.clip(light, 0, 1), atol=0.05)
    np.testing.assert_array_equal(clamped.pattern, inverse.pattern(desired))


@pytest.mark.slow
def test_masked_pixels_stay_dark():
    T = ltcl.Transport(SCENES["rho 0.8"].T * (np.arange(N) != 3), GRID, on_dark="mask")
    inverse = ltcl.invert(T, 1e-2)
    desired = np.full(GRID, 0.3)
    assert inverse.pattern(desired).ravel()[3] == 0.0
    assert ltcl.compensate(T, desired, inverse=inverse, clamp=True).pattern.ravel()[3] == 0.0


@pytest.mark.slow
def test_mixing_of_colours_is_undone():
    T = ltcl.Transport(
        [lambertian(N, 0.4, seed=seed).T for seed in range(3)], GRID, mixing=np.eye(3) + 0.1
    )
    desired = T @ random.uniform(0.3, 0.6, (*GRID, 3))
    np.testing.assert_allclose(T @ ltcl.invert(T, 1e-2).pattern(desired), desired, rtol=0.1)


@pytest.mark.parametrize("form", ["csr", "dense", "tiles of 8"])
def test_a_compressed_transport_is_inverted_as_it_is(device, form):
    scene = SCENES["rho 0.8"]
    W = Wavelet(device, GRID, "db2")
    core = FORMATS[form](device, scipy.sparse.csr_array(W.to_dense() @ scene.R @ W.to_dense().T))
    S = IdentityPlus(Compressed(core, W, W), solution_error=1e-3)
    T = ltcl.Transport(ScaledColumns(S, scene.F), GRID, first_bounce=scene.F)
    inverse = ltcl.invert(T, 1e-2)
    assert error_of(inverse, scene.S) + 1e-3 <= inverse.error <= 1e-2
    with pytest.raises(InputError, match=r"rtol is 0\.001"):
        ltcl.invert(T, 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("basis", ["haar", "pixels"])
@pytest.mark.parametrize("form", ["db2 rows", "db2", "pixels"])
def test_a_transport_of_any_form_is_inverted(form, basis):
    """The error holds for what T was compressed from: S of the scene, not that of C."""
    scene = SCENES["rho 0.8"]
    C = ltcl.compress(transport(scene), 0.01, norm="worst", basis=form)
    inverse = ltcl.invert(C, 0.1, basis=basis)
    assert error_of(inverse, scene.S) <= inverse.error <= 0.1
    assert inverse.error > C.error
    assert inverse.confidence > 0.999


@pytest.mark.rare
def test_another_first_bounce_or_somebodys_operator(device):
    """S of neither has numbers at hand: F / F' stands between, or products are all there are."""
    scene = lambertian(N, 0.8, seed=7)
    F = scene.F * np.random.default_rng(11).uniform(0.9, 1.1, N)
    stored = ScaledColumns(IdentityPlus(Dense(device, scene.R)), scene.F)
    for matrix in (stored, scipy.sparse.linalg.aslinearoperator(scene.T)):
        for basis in ("db2", "pixels"):
            inverse = ltcl.invert(ltcl.Transport(matrix, GRID, first_bounce=F), 1e-2, basis=basis)
            assert error_of(inverse, scene.T / F) <= inverse.error <= 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("basis", ["db2", "pixels"])
@pytest.mark.parametrize("rtol", [9e-7, 1e-6])
def test_a_tolerance_below_float32_is_refused_with_what_it_does(rtol, basis):
    T = transport(SCENES["rho 0.8"])
    with pytest.raises(ToleranceError, match=f"rtol is {rtol:g}") as refused:
        ltcl.invert(T, rtol, basis=basis)
    least = 1.5 * refused.value.least
    assert rtol < least < 1e-4
    assert ltcl.invert(T, least, basis=basis).error <= least


@pytest.mark.parametrize(
    ("S", "first", "least", "most"),
    [
        (1.05, 0.3, 1.05 * 1.3 - 1.0, 0.4),  # S~ = 1.05 solves to 1.3 x: errors add up and multiply
        (0.8, 0.0, 0.2 * (1 - 1e-4), 0.2 * (1 + 1e-4)),  # A is off by more: 0.2 / (1 - 0.2)
    ],
)
def test_the_errors_of_a_pixel_whose_A_is_dropped(S, first, least, most):
    """Solutions are said to be off by `first` before; A = 1 - 1 / S is below the threshold."""
    R = Dense(ltcl.open_device(), [[S - 1.0]])
    T = ltcl.Transport(
        ScaledColumns(IdentityPlus(R, solution_error=first), np.ones(1)), (1, 1), [1.0]
    )
    inverse = ltcl.invert(T, 0.5)
    A = inverse.A
    assert isinstance(A, Operator)
    assert not A.to_dense().any()
    assert least <= inverse.error <= most
    assert abs(1.0 - 1.0 / S) <= A.error * (1 + 1e-6)


SINGULAR = ltcl.Transport(np.eye(N) + np.eye(N)[::-1], GRID)
EYE = scipy.sparse.eye_array(2)
TALL = ltcl.Transport(np.ones((4, 2)), (1, 2), camera_grid=(2, 2))
GOOD = transport(SCENES["rho 0.8"])


@pytest.mark.parametrize(
    ("call", "matrix", "options", "error", "words"),
    [
        *(
            (ltcl.invert, GOOD, {"rtol": rtol}, InputError, f"rtol is {rtol}")
            for rtol in (0.0, 1.0)
        ),
        (ltcl.invert, GOOD, {"basis": "db2 rows"}, InputError, "basis is 'db2 rows'"),
        (ltcl.invert, GOOD, {"basis": "bior2.2"}, InputError, "basis is 'bior2.2'"),
        (ltcl.invert, GOOD, {"progress": 3}, InputTypeError, "progress is 3"),
        (ltcl.invert, np.eye(4), {}, InputTypeError, "T is a ndarray"),
        (ltcl.invert, TALL, {}, InputError, "S = T F"),
        (ltcl.invert, SINGULAR, {"basis": "pixels"}, InputError, "singular"),
        *(
            (invert_coefficients, EYE, {"rtol": rtol}, InputError, f"rtol is {rtol}")
            for rtol in (0.0, 1.0)
        ),
        (invert_coefficients, np.eye(2), {}, InputTypeError, "C is a ndarray"),
        (invert_coefficients, gallery.SPARSE["53x7"], {}, InputError, r"C has shape \(53, 7\)"),
        (invert_coefficients, -EYE, {}, InputError, "singular"),
        (invert_coefficients, scipy.sparse.csr_array([[np.nan]]), {}, InputError, "NaN"),
    ],
)
def test_refusals(call, matrix, options, error, words):
    with pytest.raises(error, match=words) as refused:
        call(matrix, **options)
    assert "\n" not in str(refused.value)


def rooms(matrix, method) -> Any:
    return scipy.sparse.csr_array(scipy.sparse.block_diag([matrix] * ROOMS[method]))


def error_of_coefficients(C, D):
    return relative_error(D.toarray(), np.eye(C.shape[0]) + C.toarray().astype(np.float64))


@pytest.mark.slow
@pytest.mark.parametrize("undo", [True, False])
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("rtol", [0.1, 1e-4])
@pytest.mark.parametrize("method", ROOMS)
def test_the_error_of_coefficients_is_a_bound_and_within_the_tolerance(name, undo, rtol, method):
    C = rooms(SCENES[name].R if undo else -SCENES[name].A, method)
    inverse = invert_coefficients(C, rtol=rtol)
    assert (inverse.method, inverse.status) == (method, Status.CONVERGED)
    assert error_of_coefficients(C, inverse.D) <= inverse.error <= rtol


@pytest.mark.slow
def test_thresholds_leave_few_numbers_of_what_is_smooth(monkeypatch):
    # Orthonormal; smooth pictures have few coefficients.
    W = scipy.linalg.hadamard(512) / np.sqrt(512)
    C: Any = scipy.sparse.csr_array(-W @ ltcl.scenes.dihedral(16, albedo=0.8).A @ W.T)
    monkeypatch.setattr(checks, "host_memory", lambda: 0)  # no room for elimination
    loose, tight = (invert_coefficients(C, rtol=rtol) for rtol in (3e-2, 3e-3))
    assert loose.method == tight.method == "iteration"
    assert loose.D.nnz < tight.D.nnz < 0.5 * C.shape[0] ** 2
    assert error_of_coefficients(C, tight.D) <= tight.error


@pytest.mark.parametrize("n", [1, 99])
def test_nothing_to_invert(n):
    inverse = invert_coefficients(scipy.sparse.csr_array((n, n)), rtol=1e-3)
    assert (inverse.status, inverse.D.nnz, inverse.products) == (Status.CONVERGED, 0, 0)


@pytest.mark.slow
def test_what_takes_too_many_products_is_refused_with_what_there_is(monkeypatch):
    C = rooms(-enclosure(25, 0.998).A, "iteration")
    monkeypatch.setattr(checks, "host_memory", lambda: 0)
    with pytest.raises(ConvergenceError, match="loosen rtol") as failed:
        invert_coefficients(C, rtol=1e-3)
    inverse = failed.value.solution
    assert inverse.status is Status.MAXITER
    assert error_of_coefficients(C, inverse.D) <= inverse.error


def test_eigenvalues_of_no_scene_are_eliminated_where_there_is_room(monkeypatch):
    C = rooms(-1.5 * np.eye(20), "iteration")
    inverse = invert_coefficients(C, rtol=1e-2)
    assert inverse.method == "elimination"
    assert error_of_coefficients(C, inverse.D) <= inverse.error <= 1e-2
    monkeypatch.setattr(checks, "host_memory", lambda: 0)
    with pytest.raises(InputError, match=r"eigenvalue.* -0\.5"):
        invert_coefficients(C)


def test_an_inverse_refuses_what_it_cannot_do(smooth):
    T, inverse = smooth
    p = np.full(T.grid, 0.3)
    kept = {"inverse": inverse}
    plain = ltcl.Transport(T.matrices[0], T.grid)
    other = ltcl.Transport(T.matrices[0] + 0.02, T.grid, first_bounce=T.first_bounce)
    cases: tuple[Any, ...] = (
        (r"rtol is 0\.001", ltcl.separate, T, p, {**kept, "rtol": 1e-3}),
        ("rtol is 1e-05", ltcl.compensate, T, p, {**kept, "rtol": 1e-5}),
        ("method", ltcl.compensate, T, p, {**kept, "method": "cg"}),
        ("exact", ltcl.separate, T, p, {**kept, "rtol": 0.1, "exact": T}),
        ("inverse is a Transport", ltcl.compensate, T, p, {"inverse": T}),
        ("not that of T", ltcl.compensate, other, p, kept),
        ("first bounce", ltcl.compensate, plain, p, kept),
        (
            r"grid \(8, 16\).*\(5, 6\)",
            ltcl.compensate,
            transport(SCENES["rho 0.8"]),
            np.ones(GRID),
            kept,
        ),
        (r"b has shape \(3,\)", inverse.solve, np.ones(3), {}),
        ("channel is 1", inverse.solve, np.ones(128), 1, {}),
        (r"bounds is \(1\.0, 0\.0\)", inverse.pattern, p, {"bounds": (1.0, 0.0)}),
        ("bounds.*3", inverse.pattern, p, {"bounds": 3}),
        (r"desired has shape \(3, 3\)", inverse.pattern, np.ones((3, 3)), {}),
    )
    for words, call, *arguments, options in cases:
        with pytest.raises((InputError, InputTypeError), match=words):
            call(*arguments, **options)
