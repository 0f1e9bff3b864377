# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl.invert` against dense float64 inverses: its error, and what it costs to use."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.compression import elimination, inversion
from ltcl.errors import ConvergenceError, InputError, InputTypeError, ToleranceError
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, ScaledColumns, Tiles, Wavelet
from ltcl.solvers import Inverse, Solution
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


@pytest.mark.parametrize("method", ["iteration", "elimination"])
def test_both_ways_to_invert(method):
    scene = SCENES["rho 4"]
    inverse = ltcl.invert(transport(scene), 1e-2, basis="pixels", method=method)
    assert off(inverse, scene.S) <= inverse.error <= 1e-2


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


def counted(monkeypatch):
    """The systems that products are made with from now on, one entry each."""
    products, product = [], IdentityPlus._product

    def count(self, *arguments):
        products.append(self)
        return product(self, *arguments)

    monkeypatch.setattr(IdentityPlus, "_product", count)
    return products


def test_further_frames_take_one_product_each(smooth, monkeypatch):
    T, inverse = smooth
    frames = np.full((3, *T.grid), 0.3)
    ltcl.compensate(T, frames, inverse=inverse)  # tells that the two belong together
    ltcl.separate(T, T @ frames, 1, rtol=1e-2, inverse=inverse)  # and looks for gloss
    (X,), (S,) = inverse.systems, T.systems
    products = counted(monkeypatch)
    ltcl.compensate(T, frames, inverse=inverse)
    assert products == [X, S]  # S for the appearance
    products.clear()
    inverse.pattern(frames)
    assert products == [X]
    products.clear()
    ltcl.separate(T, frames, 3, rtol=1e-2, inverse=inverse)
    assert products == [X] * 4


@pytest.mark.parametrize("columns", [(), (1,), (5,)])
def test_a_solution_is_one_product(smooth, columns, monkeypatch):
    T, inverse = smooth
    b = RNG.random((128, *columns))
    products = counted(monkeypatch)
    s = inverse.solve(b)
    assert products == [inverse.systems[0]]
    monkeypatch.undo()
    x = np.linalg.solve(T.systems[0].to_dense(), b)
    assert np.all(np.linalg.norm(s.x - x, axis=0) <= (s.error + 1e-6) * np.linalg.norm(x, axis=0))
    assert s.x.shape == b.shape
    assert (s.products, s.method, s.status.name) == (1, "precomputed", "PRECOMPUTED")
    assert s.converged
    assert "relative error at most" in str(s)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_light_of_any_size(smooth, scale):
    _, inverse = smooth
    b = RNG.random(128)
    np.testing.assert_allclose(inverse.solve(scale * b).x / scale, inverse.solve(b).x, rtol=1e-4, atol=1e-6)


def test_compensation_and_separation_agree_with_solves(smooth):
    T, inverse = smooth
    desired = RNG.uniform(0.3, 0.35, (3, *T.grid))
    ours, solved = (ltcl.compensate(T, desired, bounds=(-9, 9), inverse=i) for i in (inverse, None))
    assert np.linalg.norm(ours.pattern - solved.pattern) <= 0.03 * np.linalg.norm(solved.pattern)
    assert isinstance(ours.solution, Solution)
    assert ours.solution.products == 1
    picture = T @ RNG.random(T.grid)
    b, exact = (
        ltcl.separate(T, picture, 2, rtol=1e-2, inverse=inverse),
        ltcl.separate(T, picture, 2, rtol=1e-6),
    )
    assert [s.products for s in b.solutions if isinstance(s, Solution)] == [1, 1, 1]
    assert np.linalg.norm(b.direct - exact.direct) <= inverse.error * np.linalg.norm(exact.direct)
    np.testing.assert_allclose(b.direct + b.bounces.sum(axis=0) + b.rest, picture, atol=1e-5)


def test_the_bounds_still_hold_and_are_still_least_squares(smooth):
    T, inverse = smooth
    desired = RNG.uniform(0.0, 1.0, T.grid)
    ours, solved = (ltcl.compensate(T, desired, inverse=i) for i in (inverse, None))
    assert abs(ours.error - solved.error) <= 0.02
    assert ours.limited


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


def test_clamping_where_nothing_exceeds_the_bounds_changes_nothing(smooth):
    T, inverse = smooth
    desired = np.full(T.grid, 0.3)
    c = ltcl.compensate(T, desired, clamp=True, inverse=inverse)
    np.testing.assert_array_equal(c.pattern, ltcl.compensate(T, desired, inverse=inverse).pattern)
    assert c.clipped == 0.0


def test_patterns_of_frames_and_colours(smooth):
    T, inverse = smooth
    frames = RNG.uniform(0.3, 0.6, (4, *T.grid, 3))
    patterns = inverse.pattern(frames, gain=0.5, background=0.01, bounds=(0.0, 2.0))
    solved = ltcl.compensate(
        T, frames, gain=0.5, background=0.01, bounds=(0.0, 2.0), inverse=inverse, clamp=True
    )
    np.testing.assert_array_equal(patterns, solved.pattern)
    assert patterns.dtype == np.float32


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
    with pytest.raises(
        InputError, match=r"rtol is 0.001, but T is compressed and .* off by 0.001; ask for more"
    ):
        ltcl.invert(T, 1e-3)


@pytest.mark.parametrize("basis", [("db2", "pixels"), "haar", "pixels"])
@pytest.mark.parametrize("form", ["db2 rows", "haar rows", "db2 + pixels", "db2", "hilbert", "pixels"])
def test_a_transport_of_any_form_is_inverted(form, basis):
    """The error holds for what T was compressed from: S of the scene, not that of C."""
    scene = SCENES["rho 0.8"]
    C = ltcl.compress(transport(scene), 0.01, basis=form)
    inverse = ltcl.invert(C, 0.1, basis=basis)
    assert off(inverse, scene.S) <= inverse.error <= 0.1
    assert inverse.error > C.error
    assert inverse.confidence > 0.999


def test_a_sharp_and_smooth_transport_goes_from_compress_to_invert():
    """Whichever of all kinds is taken: a permutation and a smooth kernel together suit a sum best."""
    n, rng = 256, np.random.default_rng(0)
    y, x = np.divmod(np.arange(n), 16)
    R = np.exp(-((x[:, None] - x) ** 2 + (y[:, None] - y) ** 2) / 30.0)
    R *= 0.4 / np.linalg.norm(R, 2)
    R[np.arange(n), rng.permutation(n)] += 0.3
    np.fill_diagonal(R, 0.0)
    T = ltcl.Transport(np.eye(n) + R, (16, 16))
    for basis in (None, "db2 + pixels"):
        inverse = ltcl.invert(ltcl.compress(T, 0.01, basis=basis), 0.3)
        assert off(inverse, np.eye(n) + R) <= inverse.error <= 0.3


def test_wavelets_on_one_side_with_an_error_that_is_added(device):
    scene = SCENES["rho 0.8"]
    W = Wavelet(device, GRID, "db2")
    R = Compressed(Dense(device, scene.R @ W.to_dense().T), None, W)
    for error in (0.0, 0.02):
        S = IdentityPlus(R, solution_error=error)
        T = ltcl.Transport(ScaledColumns(S, scene.F), GRID, first_bounce=scene.F)
        inverse = ltcl.invert(T, 0.05)
        assert off(inverse, scene.S) + error <= inverse.error <= 0.05
    with pytest.raises(InputError, match=r"off by 0.02; ask for more"):
        ltcl.invert(T, 0.02)


def test_another_first_bounce_or_somebodys_operator(device):
    """S of neither has numbers at hand: F / F' stands between, or products are all there are."""
    scene, F = SCENES["rho 0.8"], SCENES["rho 0.8"].F * RNG.uniform(0.9, 1.1, 48)
    kept = ScaledColumns(IdentityPlus(Dense(device, scene.R)), scene.F)
    own = scipy.sparse.linalg.aslinearoperator(scene.T)
    for matrix in (kept, own):
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
@pytest.mark.parametrize("basis", [("db2", "pixels"), "pixels"])
@pytest.mark.parametrize("rtol", [1e-9, 9.7e-8, 5e-7])
def test_a_tolerance_below_float32_is_told_as_it_was_given_with_one_that_works(rtol, basis, method):
    T = transport(SCENES["rho 0.8"])
    with pytest.raises(ToleranceError) as refused:
        ltcl.invert(T, rtol, basis=basis, method=method)
    text = str(refused.value)
    assert text.startswith(f"rtol is {rtol:g}, which float32 does not keep for the inverse of this T; the ")
    least = float(text.rpartition(" ")[2])
    assert least == refused.value.least < 1e-5
    assert ltcl.invert(T, least, basis=basis, method=method).error <= least
    with pytest.raises(ToleranceError):
        ltcl.invert(T, least / 4, basis=basis, method=method)


@pytest.mark.parametrize("form", ["db2", "db2 rows"])
def test_so_is_one_just_above_the_error_of_a_compressed_T(form):
    C = ltcl.compress(transport(SCENES["rho 0.8"]), 0.05, basis=form)
    with pytest.raises(InputError) as refused:
        ltcl.invert(C, C.error * (1 + 1e-7))
    least = float(str(refused.value).partition("; the least that it does is ")[2])
    assert C.error < least <= 1.2 * C.error
    assert ltcl.invert(C, least).error <= least


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
    assert re.fullmatch(
        r"S of T has an eigenvalue of real part -0.57\d?, as of no scene: check the first bounce, or give "
        "method='elimination', which is dense, N x N",
        str(refused.value),
    )


def test_where_there_is_no_room_to_eliminate_it_is_named(monkeypatch):
    monkeypatch.setattr(elimination, "_LARGEST", 8)
    with pytest.raises(InputError, match=r"S of T has an eigenvalue .* or give method='elimination'"):
        ltcl.invert(uneven()[1], 0.1, basis="pixels")


def test_a_singular_S_is_named_as_that_of_T():
    S = np.eye(48)
    S[:2, :2] = 1.0
    with pytest.raises(InputError, match=r"^S of T is singular, as of no scene: check the first bounce$"):
        ltcl.invert(ltcl.Transport(S, GRID), 0.1, basis="pixels", method="elimination")


def test_an_iteration_that_ends_early_says_so_of_T(monkeypatch):
    given = inversion.invert_coefficients
    monkeypatch.setattr(
        inversion, "invert_coefficients", lambda *args, **options: given(*args, maxiter=1, **options)
    )
    with pytest.raises(ConvergenceError) as refused:
        ltcl.invert(transport(SCENES["rho 4"]), 1e-3, basis="pixels", method="iteration")
    assert re.fullmatch(
        r"S of T was not inverted: iteration maxiter after 1 products, error [\d.]+; give "
        "method='elimination', or loosen rtol",
        str(refused.value),
    )
    assert refused.value.solution.products == 1
    assert ltcl.invert(transport(SCENES["rho 4"]), 1e-3, basis="pixels").error <= 1e-3  # by elimination


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"rtol": 0.0}, InputError, "rtol is 0.0"),
        ({"rtol": 1.0}, InputError, "rtol is 1.0"),
        ({"basis": "db2 rows"}, InputError, "basis is 'db2 rows'; an inverse needs one basis on both sides"),
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


def test_separation_asks_for_no_more_than_there_is_unless_told_to(smooth):
    T, inverse = smooth
    picture = T @ np.full(T.grid, 0.3)
    exact, found = ltcl.separate(T, picture, 2, rtol=1e-5), ltcl.separate(T, picture, 2, inverse=inverse)
    counts = [one.products for one in found.solutions if isinstance(one, Solution)]
    assert counts == [1, 1, 1]
    off = np.linalg.norm(found.direct - exact.direct) / np.linalg.norm(exact.direct)
    assert 0.0 < off <= inverse.error


def test_what_it_cannot_do_is_refused_before_it_does_anything(smooth):
    T, inverse = smooth
    picture = np.full(T.grid, 0.3)
    with pytest.raises(InputError, match=r"rtol is 0.001, but what this inverse gives may be off by 0.0"):
        ltcl.separate(T, picture, rtol=1e-3, inverse=inverse)
    with pytest.raises(InputError, match=r"rtol is 1e-05, but what this inverse"):
        ltcl.compensate(T, picture, rtol=1e-5, inverse=inverse)
    with pytest.raises(InputError, match=r"b has shape \(3,\); it must be \(128,\)"):
        inverse.solve(np.ones(3))
    with pytest.raises(InputError, match="channel is 1; it must be below 1"):
        inverse.solve(np.ones(128), 1)
    for bounds in ((1.0, 0.0), 3):
        with pytest.raises(InputError, match="bounds"):
            inverse.pattern(picture, bounds=bounds)
    with pytest.raises(InputError, match=r"desired has shape \(3, 3\)"):
        inverse.pattern(np.ones((3, 3)))
    with pytest.raises(InputError, match="method is given, but inverse takes the place"):
        ltcl.compensate(T, picture, method="cg", inverse=inverse)
    with pytest.raises(InputError, match="exact is given, but inverse takes the place"):
        ltcl.separate(T, picture, rtol=0.1, exact=T, inverse=inverse)
    with pytest.raises(InputTypeError, match="option 'maxiter' is given"):
        ltcl.separate(T, picture, rtol=0.1, maxiter=3, inverse=inverse)
    with pytest.raises(InputTypeError, match=r"inverse is a Transport; it must be what ltcl.invert"):
        ltcl.compensate(T, picture, inverse=T)
    with pytest.raises(InputTypeError, match="clamp is 3; it must be True or False"):
        ltcl.compensate(T, picture, clamp=3)  # pyright: ignore[reportArgumentType]


def test_the_inverse_of_another_transport_is_refused(smooth):
    T, inverse = smooth
    scene = ltcl.scenes.dihedral(8, albedo=0.8)
    other = ltcl.Transport(T.matrices[0] + 0.02, T.grid, first_bounce=scene.first_bounce)
    picture = np.full(T.grid, 0.3)
    with pytest.raises(InputError, match="inverse is not that of T: a random light comes back off by"):
        ltcl.compensate(other, picture, inverse=inverse)
    with pytest.raises(InputError, match="inverse has another first bounce than T"):
        ltcl.compensate(ltcl.Transport(T.matrices[0], T.grid), picture, inverse=inverse)
    with pytest.raises(InputError, match=r"inverse has grid \(8, 16\); it must be that of T, \(6, 8\)"):
        ltcl.compensate(transport(SCENES["rho 0.8"]), np.ones(GRID), inverse=inverse)


def test_clamping_needs_an_S():
    T = ltcl.Transport(np.ones((4, 2)), (1, 2), camera_grid=(2, 2))
    with pytest.raises(InputError, match="clamp is True, but this T has no S"):
        ltcl.compensate(T, np.ones((2, 2)), clamp=True)


def test_an_inverse_says_what_it_is(smooth):
    _, inverse = smooth
    assert isinstance(inverse, Inverse)
    assert repr(inverse).startswith("<ltcl Inverse 128 x 128, grey, grid 8 x 16, ")
    assert inverse.confidence > 0.999
