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
random = np.random.default_rng(5)
SCENES = {
    "rho 0.8": lambertian(48, 0.8, seed=1),
    "rho 4": lambertian(48, 4.0, seed=2),
    "albedo 0.9": enclosure(48, 0.9, seed=3),
}


def transport(scene, **options):
    return ltcl.Transport(scene.T, GRID, first_bounce=scene.F, **options)


def relative_error(inverse, S, channel=0):
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
    assert relative_error(inverse, scene.S) <= inverse.error <= rtol
    A = inverse.systems[0].R
    assert np.linalg.norm(A.to_dense() - scene.A, 2) <= A.error


@pytest.mark.parametrize("forms", [None, ("db2", "db2 rows", "haar")])
def test_colours_have_their_own(forms):
    """Channels that were compressed in several forms are written in one basis."""
    scenes = [lambertian(48, rho, seed=7) for rho in (0.2, 0.8, 2.0)]
    matrices = [scene.T for scene in scenes]
    if forms:
        matrices = [
            ltcl.compress(transport(scene), 0.01, basis=basis).matrices[0]
            for scene, basis in zip(scenes, forms, strict=True)
        ]
    T = ltcl.Transport(matrices, GRID, first_bounce=np.stack([scene.F for scene in scenes]))
    inverse = ltcl.invert(T, 0.05)
    assert inverse.channels == 3
    for channel, scene in enumerate(scenes):
        assert relative_error(inverse, scene.S, channel) <= inverse.errors[channel] <= inverse.error <= 0.05
    desired = random.uniform(0.2, 0.3, (*GRID, 3))
    c = ltcl.compensate(T, desired, bounds=(-10, 10), inverse=inverse)
    assert isinstance(c.solution, tuple)
    assert [s.products for s in c.solution] == [1, 1, 1]
    assert c.error <= 0.1


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


def test_masked_pixels_stay_dark():
    T = ltcl.Transport(SCENES["rho 0.8"].T * (np.arange(48) != 3), GRID, on_dark="mask")
    inverse = ltcl.invert(T, 1e-2)
    desired = np.full(GRID, 0.3)
    assert inverse.pattern(desired).ravel()[3] == 0.0
    assert ltcl.compensate(T, desired, inverse=inverse, clamp=True).pattern.ravel()[3] == 0.0


def test_mixing_of_colours_is_undone():
    T = ltcl.Transport([lambertian(48, 0.4, seed=seed).T for seed in range(3)], GRID, mixing=np.eye(3) + 0.1)
    desired = T @ random.uniform(0.3, 0.6, (*GRID, 3))
    np.testing.assert_allclose(T @ ltcl.invert(T, 1e-2).pattern(desired), desired, rtol=0.1)


@pytest.mark.parametrize("kind", [CSR, Dense, lambda device, core: Tiles(device, core, 8, "float32")])
def test_a_compressed_transport_is_inverted_as_it_is(device, kind):
    scene = SCENES["rho 0.8"]
    W = Wavelet(device, GRID, "db2")
    core = W.to_dense() @ scene.R @ W.to_dense().T
    core = kind(device, core if kind is Dense else scipy.sparse.csr_array(core))
    S = IdentityPlus(Compressed(core, W, W), solution_error=1e-3)
    T = ltcl.Transport(ScaledColumns(S, scene.F), GRID, first_bounce=scene.F)
    inverse = ltcl.invert(T, 1e-2)
    assert relative_error(inverse, scene.S) + 1e-3 <= inverse.error <= 1e-2
    with pytest.raises(InputError, match=r"rtol is 0\.001"):
        ltcl.invert(T, 1e-3)


@pytest.mark.parametrize("basis", ["haar", "pixels"])
@pytest.mark.parametrize("form", ["db2 rows", "db2", "pixels"])
def test_a_transport_of_any_form_is_inverted(form, basis):
    """The error holds for what T was compressed from: S of the scene, not that of C."""
    scene = SCENES["rho 0.8"]
    C = ltcl.compress(transport(scene), 0.01, basis=form)
    inverse = ltcl.invert(C, 0.1, basis=basis)
    assert relative_error(inverse, scene.S) <= inverse.error <= 0.1
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
            assert relative_error(inverse, scene.T / F) <= inverse.error <= 1e-2


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
    """Solutions of T = S are said to be off by `first` before; A = 1 - 1 / S is below the threshold."""
    R = Dense(ltcl.open_device(), [[S - 1.0]])
    T = ltcl.Transport(ScaledColumns(IdentityPlus(R, solution_error=first), np.ones(1)), (1, 1), [1.0])
    inverse = ltcl.invert(T, 0.5)
    A = inverse.A
    assert isinstance(A, Operator)
    assert not A.to_dense().any()
    assert least <= inverse.error <= most
    assert abs(1.0 - 1.0 / S) <= A.error * (1 + 1e-6)


SINGULAR = ltcl.Transport(np.eye(48) + np.eye(48)[::-1], GRID)


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"rtol": 0.0}, InputError, "rtol is 0.0"),
        ({"rtol": 1.0}, InputError, "rtol is 1.0"),
        ({"basis": "db2 rows"}, InputError, "basis is 'db2 rows'"),
        ({"basis": "bior2.2"}, InputError, "basis is 'bior2.2'"),
        ({"T": np.eye(4)}, InputTypeError, "T is a ndarray"),
        ({"T": ltcl.Transport(np.ones((4, 2)), (1, 2), camera_grid=(2, 2))}, InputError, "S = T F"),
        ({"T": SINGULAR, "basis": "pixels"}, InputError, "singular"),
    ],
)
def test_refusals(change, error, words):
    with pytest.raises(error, match=words) as refused:
        ltcl.invert(**{"T": transport(SCENES["rho 0.8"]), **change})
    assert "\n" not in str(refused.value)


REFUSED_CALLS = {
    r"rtol is 0\.001": lambda T, p, inverse: ltcl.separate(T, p, rtol=1e-3, inverse=inverse),
    "rtol is 1e-05": lambda T, p, inverse: ltcl.compensate(T, p, rtol=1e-5, inverse=inverse),
    r"b has shape \(3,\)": lambda T, p, inverse: inverse.solve(np.ones(3)),
    "channel is 1": lambda T, p, inverse: inverse.solve(np.ones(128), 1),
    r"bounds is \(1\.0, 0\.0\)": lambda T, p, inverse: inverse.pattern(p, bounds=(1.0, 0.0)),
    "bounds.*3": lambda T, p, inverse: inverse.pattern(p, bounds=3),
    r"desired has shape \(3, 3\)": lambda T, p, inverse: inverse.pattern(np.ones((3, 3))),
    "method": lambda T, p, inverse: ltcl.compensate(T, p, method="cg", inverse=inverse),
    "exact": lambda T, p, inverse: ltcl.separate(T, p, rtol=0.1, exact=T, inverse=inverse),
    "inverse is a Transport": lambda T, p, inverse: ltcl.compensate(T, p, inverse=T),
    "not that of T": lambda T, p, inverse: ltcl.compensate(
        ltcl.Transport(T.matrices[0] + 0.02, T.grid, first_bounce=T.first_bounce), p, inverse=inverse
    ),
    "first bounce": lambda T, p, inverse: ltcl.compensate(
        ltcl.Transport(T.matrices[0], T.grid), p, inverse=inverse
    ),
    r"grid \(8, 16\).*\(6, 8\)": lambda T, p, inverse: ltcl.compensate(
        transport(SCENES["rho 0.8"]), np.ones(GRID), inverse=inverse
    ),
}


@pytest.mark.parametrize("words", REFUSED_CALLS)
def test_an_inverse_refuses_what_it_cannot_do(smooth, words):
    T, inverse = smooth
    with pytest.raises((InputError, InputTypeError), match=words):
        REFUSED_CALLS[words](T, np.full(T.grid, 0.3), inverse)
