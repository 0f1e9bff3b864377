# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl.invert` against dense float64 inverses: its error, and what it costs to use."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import ltcl
from ltcl.errors import InputError, InputTypeError, ToleranceError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Operator, ScaledColumns, Tiles, Wavelet
from tests.problems import enclosure, lambertian

GRID = (6, 8)
RNG = np.random.default_rng(5)
SCENES = {
    "rho 0.8": lambertian(48, 0.8, seed=1),
    "rho 4": lambertian(48, 4.0, seed=2),
    "albedo 0.9": enclosure(48, 0.9, seed=3),
}


def transport(scene, **options):
    return ltcl.Transport(scene.T, GRID, first_bounce=scene.F, **options)


def off(inverse, S, channel=0):
    """||I - (I - A~) S||_2 in float64: the largest relative error of a solution there is."""
    eye = np.eye(len(S))
    return np.linalg.norm(eye - (eye - inverse.systems[channel].R.to_dense()) @ S, 2)


@pytest.fixture(scope="module")
def smooth():
    scene = ltcl.scenes.dihedral(8, albedo=0.8)
    T = scene.transport(first_bounce=scene.first_bounce)
    return T, ltcl.invert(T, 1e-2)


@pytest.mark.parametrize("basis", ["db2", "pixels"])
@pytest.mark.parametrize("rtol", [0.1, 1e-3])
@pytest.mark.parametrize("name", SCENES)
def test_the_error_is_a_bound_and_within_the_tolerance(name, rtol, basis):
    scene = SCENES[name]
    inverse = ltcl.invert(transport(scene), rtol, basis=basis)
    assert off(inverse, scene.S) <= inverse.error <= rtol
    A = inverse.systems[0].R
    assert np.linalg.norm(A.to_dense() - scene.A, 2) <= A.error


def test_A_is_one_bounce(smooth):
    _, inverse = smooth
    scene = ltcl.scenes.dihedral(8, albedo=0.8)
    direct = RNG.random(128)
    bounced = inverse.A @ direct
    assert np.linalg.norm(bounced - scene.A @ direct) <= inverse.A.error * np.linalg.norm(direct)
    assert isinstance(inverse.A, Compressed)
    assert inverse.A.out is inverse.A.into
    assert inverse.nbytes == inverse.A.nbytes


def test_colours_have_their_own(smooth):
    scenes = [lambertian(48, rho, seed=7) for rho in (0.2, 0.8, 2.0)]
    T = ltcl.Transport(
        [scene.T for scene in scenes], GRID, first_bounce=np.stack([scene.F for scene in scenes])
    )
    inverse = ltcl.invert(T, 1e-2)
    assert inverse.channels == 3
    for channel, scene in enumerate(scenes):
        assert off(inverse, scene.S, channel) <= inverse.errors[channel] <= inverse.error <= 1e-2
    desired = RNG.uniform(0.2, 0.3, (*GRID, 3))
    c = ltcl.compensate(T, desired, bounds=(-10, 10), inverse=inverse)
    assert isinstance(c.solution, tuple)
    assert [s.products for s in c.solution] == [1, 1, 1]
    assert c.error <= 2e-2


def test_clamping_is_quick_and_says_what_it_costs(smooth):
    T, inverse = smooth
    desired = RNG.uniform(0.0, 1.0, T.grid)
    clamped = ltcl.compensate(T, desired, inverse=inverse, clamp=True)
    best = ltcl.compensate(T, desired, inverse=inverse)
    light = np.linalg.solve(T.systems[0].to_dense(), desired.ravel()) / T.first_bounce
    assert clamped.limited == ()
    assert clamped.error >= best.error - best.gap
    assert clamped.gap == clamped.error
    assert clamped.clipped == pytest.approx(np.mean((light < 0) | (light > 1)), abs=0.02)
    np.testing.assert_allclose(clamped.pattern.ravel(), np.clip(light, 0, 1), atol=0.05)
    np.testing.assert_array_equal(clamped.pattern, inverse.pattern(desired))


def test_masked_pixels_stay_dark():
    matrix = SCENES["rho 0.8"].T.copy()
    matrix[:, 3] = 0.0
    T = ltcl.Transport(matrix, GRID, on_dark="mask")
    inverse = ltcl.invert(T, 1e-2)
    desired = np.full(GRID, 0.3)
    assert inverse.pattern(desired).ravel()[3] == 0.0
    assert ltcl.compensate(T, desired, inverse=inverse, clamp=True).pattern.ravel()[3] == 0.0


def test_mixing_of_colours_is_undone():
    scenes = [lambertian(48, 0.4, seed=seed) for seed in range(3)]
    M = np.eye(3) + 0.1
    T = ltcl.Transport([s.T for s in scenes], GRID, first_bounce=np.stack([s.F for s in scenes]), mixing=M)
    inverse = ltcl.invert(T, 1e-2)
    desired = T @ RNG.uniform(0.3, 0.6, (*GRID, 3))
    np.testing.assert_allclose(T @ inverse.pattern(desired), desired, rtol=0.1)


@pytest.mark.parametrize("core", ["csr", "tiles", "dense"])
def test_a_compressed_transport_is_inverted_as_it_is(device, core):
    scene = SCENES["rho 0.8"]
    W = Wavelet(device, GRID, "db2")
    dense = W.to_dense() @ scene.R @ W.to_dense().T
    made = {
        "csr": lambda: CSR(device, scipy.sparse.csr_array(dense)),
        "tiles": lambda: Tiles(device, scipy.sparse.csr_array(dense), 8, "float32"),
        "dense": lambda: Dense(device, dense),
    }[core]()
    S = IdentityPlus(Compressed(made, W, W), solution_error=1e-3)
    T = ltcl.Transport(ScaledColumns(S, scene.F), GRID, first_bounce=scene.F)
    inverse = ltcl.invert(T, 1e-2)
    assert off(inverse, scene.S) + 1e-3 <= inverse.error <= 1e-2
    with pytest.raises(InputError, match=r"rtol is 0\.001"):
        ltcl.invert(T, 1e-3)


@pytest.mark.parametrize("basis", ["haar", "pixels"])
@pytest.mark.parametrize("form", ["db2 rows", "db2 + pixels", "db2", "pixels"])
def test_a_transport_of_any_form_is_inverted(form, basis):
    """The error holds for what T was compressed from: S of the scene, not that of C."""
    scene = SCENES["rho 0.8"]
    C = ltcl.compress(transport(scene), 0.01, basis=form)
    inverse = ltcl.invert(C, 0.1, basis=basis)
    assert off(inverse, scene.S) <= inverse.error <= 0.1
    assert inverse.error > C.error
    assert inverse.confidence > 0.999


def test_another_first_bounce_or_somebodys_operator(device):
    """S of neither has numbers at hand: F / F' stands between, or products are all there are."""
    scene = lambertian(48, 0.8, seed=7)
    F = scene.F * np.random.default_rng(11).uniform(0.9, 1.1, 48)
    stored = ScaledColumns(IdentityPlus(Dense(device, scene.R)), scene.F)
    for matrix in (stored, scipy.sparse.linalg.aslinearoperator(scene.T)):
        for basis in ("db2", "pixels"):
            inverse = ltcl.invert(ltcl.Transport(matrix, GRID, first_bounce=F), 1e-2, basis=basis)
            assert off(inverse, scene.T / F) <= inverse.error <= 1e-2


def test_colours_of_several_forms(device):
    """One channel is a sum, the others are not: all are written in one basis."""
    scenes = [lambertian(48, rho, seed=7) for rho in (0.2, 0.8, 2.0)]
    F = np.stack([scene.F for scene in scenes])
    parts = [
        ltcl.compress(transport(scene), 0.01, basis=basis).matrices[0]
        for scene, basis in zip(scenes, ("db2", "db2 + pixels", "haar rows"), strict=True)
    ]
    inverse = ltcl.invert(ltcl.Transport(parts, GRID, first_bounce=F), 0.1)
    for channel, scene in enumerate(scenes):
        assert off(inverse, scene.S, channel) <= inverse.errors[channel] <= 0.1


@pytest.mark.parametrize("method", ["auto", "iteration"])
@pytest.mark.parametrize("basis", ["db2", "pixels"])
@pytest.mark.parametrize("rtol", [1e-9, 5e-7])
def test_a_tolerance_below_float32_is_refused_with_what_it_does(rtol, basis, method):
    T = transport(SCENES["rho 0.8"])
    with pytest.raises(ToleranceError, match=f"rtol is {rtol:g}") as refused:
        ltcl.invert(T, rtol, basis=basis, method=method)
    least = 1.5 * refused.value.least
    assert rtol < least < 1e-4
    assert ltcl.invert(T, least, basis=basis, method=method).error <= least


def one_pixel(S, off=0.0):
    """T = S of a pixel, of which solutions are said to be off by `off`."""
    R = Dense(ltcl.open_device(), [[S - 1.0]])
    return ltcl.Transport(ScaledColumns(IdentityPlus(R, solution_error=off), np.ones(1)), (1, 1), [1.0])


def test_errors_of_both_steps_add_up_and_multiply():
    """S~ = 1.05 solves to 1.3 x, and A = 0 where 1 - 1 / 1.05 is small enough to be dropped: 1.05 * 1.3 x."""
    inverse = ltcl.invert(one_pixel(1.05, off=0.3), 0.5)
    A = inverse.A
    assert isinstance(A, Operator)
    assert not A.to_dense().any()
    assert 1.05 * 1.3 - 1.0 <= inverse.error <= 0.4


def test_the_error_of_A_is_that_of_the_inverse_of_S():
    """A = 1 - 1 / 0.7 is dropped: solutions are off by 0.3, A by 0.3 / (1 - 0.3)."""
    inverse = ltcl.invert(one_pixel(0.7), 0.5, method="iteration")
    A = inverse.A
    assert isinstance(A, Operator)
    assert not A.to_dense().any()
    assert inverse.error == pytest.approx(0.3, rel=1e-4)
    assert abs(1.0 - 1.0 / 0.7) <= A.error * (1 + 1e-6) <= 0.45


def uneven():
    """Invertible, but no scene: one eigenvalue of S is -0.575, all others 1.025."""
    A = np.eye(64) - (np.ones((64, 64)) - np.eye(64)) * 1.6 / 64
    return A, ltcl.Transport(A, (8, 8))


@pytest.mark.parametrize("basis", ["db2", "haar", "pixels"])
def test_what_the_iteration_cannot_invert_is_eliminated(basis):
    S, T = uneven()
    inverse = ltcl.invert(T, 0.1, basis=basis)
    assert off(inverse, S) <= inverse.error <= 0.1
    with pytest.raises(InputError) as refused:
        ltcl.invert(T, 0.1, basis=basis, method="iteration")
    assert "eigenvalue" in str(refused.value)
    assert "elimination" in str(refused.value)


def test_a_singular_S_is_named_as_that_of_T():
    S = np.eye(48)
    S[:2, :2] = 1.0
    with pytest.raises(InputError, match="singular"):
        ltcl.invert(ltcl.Transport(S, GRID), 0.1, basis="pixels", method="elimination")


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"rtol": 0.0}, InputError, "rtol is 0.0"),
        ({"rtol": 1.0}, InputError, "rtol is 1.0"),
        ({"basis": "db2 rows"}, InputError, "basis is 'db2 rows'"),
        ({"basis": "bior2.2"}, InputError, "basis is 'bior2.2'"),
        ({"method": "lu"}, InputError, "method is 'lu'"),
        ({"T": np.eye(4)}, InputTypeError, "T is a ndarray"),
        ({"T": ltcl.Transport(np.ones((4, 2)), (1, 2), camera_grid=(2, 2))}, InputError, "S = T F"),
    ],
)
def test_refusals(change, error, words):
    with pytest.raises(error, match=words) as refused:
        ltcl.invert(**{"T": transport(SCENES["rho 0.8"]), **change})
    assert "\n" not in str(refused.value)


def test_what_it_cannot_do_is_refused_before_it_does_anything(smooth):
    T, inverse = smooth
    picture = np.full(T.grid, 0.3)
    with pytest.raises(InputError, match=r"rtol is 0\.001"):
        ltcl.separate(T, picture, rtol=1e-3, inverse=inverse)
    with pytest.raises(InputError, match="rtol is 1e-05"):
        ltcl.compensate(T, picture, rtol=1e-5, inverse=inverse)
    with pytest.raises(InputError, match=r"b has shape \(3,\)"):
        inverse.solve(np.ones(3))
    with pytest.raises(InputError, match="channel is 1"):
        inverse.solve(np.ones(128), 1)
    for bounds in ((1.0, 0.0), 3):
        with pytest.raises(InputError, match="bounds"):
            inverse.pattern(picture, bounds=bounds)
    with pytest.raises(InputError, match=r"desired has shape \(3, 3\)"):
        inverse.pattern(np.ones((3, 3)))
    with pytest.raises(InputError, match="method"):
        ltcl.compensate(T, picture, method="cg", inverse=inverse)
    with pytest.raises(InputError, match="exact"):
        ltcl.separate(T, picture, rtol=0.1, exact=T, inverse=inverse)
    with pytest.raises(InputTypeError, match="inverse is a Transport"):
        ltcl.compensate(T, picture, inverse=T)


def test_the_inverse_of_another_transport_is_refused(smooth):
    T, inverse = smooth
    scene = ltcl.scenes.dihedral(8, albedo=0.8)
    other = ltcl.Transport(T.matrices[0] + 0.02, T.grid, first_bounce=scene.first_bounce)
    picture = np.full(T.grid, 0.3)
    with pytest.raises(InputError, match="inverse is not that of T"):
        ltcl.compensate(other, picture, inverse=inverse)
    with pytest.raises(InputError, match="inverse has another first bounce than T"):
        ltcl.compensate(ltcl.Transport(T.matrices[0], T.grid), picture, inverse=inverse)
    with pytest.raises(InputError, match=r"inverse has grid \(8, 16\).*\(6, 8\)"):
        ltcl.compensate(transport(SCENES["rho 0.8"]), np.ones(GRID), inverse=inverse)
