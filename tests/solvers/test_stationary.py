# SPDX-License-Identifier: BSD-3-Clause
"""Steps are partial sums of the series (eq. 10, 18, 20), and no more than theory says; then all
methods at every albedo, bounces added and undone."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import ITERATIVE, failed

SCENE = lambertian(31, rho=0.8, seed=2)
PLAIN = pytest.mark.parametrize(
    ("method", "options"), [("jacobi", {}), ("neumann", {}), ("richardson", {"omega": 1.0})]
)
random = np.random.default_rng(3)


@pytest.mark.parametrize("terms", [1, 2, 7, 12])
@pytest.mark.parametrize(
    ("matrix", "sign"), [(SCENE.R, 1), (SCENE.A, -1)], ids=["inverse", "forward"]
)
@PLAIN
def test_k_steps_are_k_terms(device, method, options, matrix, sign, terms):
    """The series are I - R + R^2 - ... (eq. 10) and, on I - A, I + A + A^2 + ... (eq. 4)."""
    b = random.uniform(0.0, 1.0, (SCENE.n, 2))
    S = IdentityPlus(Dense(device, matrix), sign)
    s = ltcl.solve(S, b, method, rtol=1e-6, maxiter=terms, throw=False, **options)
    assert (s.iterations, len(s.residuals)) == (terms, terms + 1)
    exact = sum(
        (np.linalg.matrix_power(-sign * matrix, k) @ b for k in range(terms)), np.zeros_like(b)
    )
    # Each step rounds a sum of n float32 products.
    np.testing.assert_allclose(
        s.x, exact, rtol=0, atol=terms * SCENE.n * 2**-24 * np.abs(exact).max()
    )
    assert residual(np.eye(SCENE.n) + sign * matrix, s.x, b) == pytest.approx(
        s.residual, rel=1e-2, abs=1e-6
    )


@pytest.mark.parametrize("columns", [(), (3,)])
@pytest.mark.parametrize("rho", [1.05, 9.0])
@PLAIN
def test_past_radius_one_it_diverges_with_its_best_iterate(device, method, options, rho, columns):
    scene = lambertian(30, rho)
    b = scene.S @ random.uniform(0.0, 1.0, (scene.n, *columns))
    s = failed(IdentityPlus(Dense(device, scene.R)), b, method, **options)
    assert s.status is Status.DIVERGED
    assert min(s.residuals) <= s.residual <= 1.0 + 1e-6
    assert residual(scene.S, s.x, b) == pytest.approx(s.residual, rel=1e-3)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.5, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("method", ["richardson", "chebyshev"])
def test_a_closed_room_takes_no_more_products_than_the_bound(device, method, seed, rho, rtol):
    """S is symmetric with spectrum in [1 / (1 + m), 1 + rho], so that the bound is strict."""
    scene = enclosure(40, rho / (1 + rho), seed)
    S = IdentityPlus(Dense(device, scene.R))
    b = random.normal(size=(scene.n, 3))
    s = ltcl.solve(S, b, method, rtol=rtol)
    assert residual(scene.S, s.x, b) <= rtol * (1 + 1e-3)
    foreseen = theory.chebyshev_products if method == "chebyshev" else theory.richardson_products
    assert s.products <= foreseen(0.5, 1 + rho, rtol) + 1  # one for rounding at the edge
    if (method, rho, rtol) == ("chebyshev", 4.0, 1e-2):
        assert s.products <= 8


@pytest.mark.parametrize("rtol", [1e-2, 1e-5])
@pytest.mark.parametrize("rho", [50.0, 200.0])
@pytest.mark.parametrize("seed", range(8))
def test_residuals_that_swing_are_not_taken_for_trouble(device, seed, rho, rtol):
    """A residual close to 0 by chance is neither a floor nor a start of growth."""
    scene = lambertian(60, rho, seed, density=0.3)
    S = IdentityPlus(Dense(device, scene.R))
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(S, b, "chebyshev", rtol=rtol)
    # The bound holds in the area / albedo norm, whose weights differ by 3 at most.
    assert s.products <= theory.chebyshev_products(*theory.free_bounds(S), rtol / np.sqrt(3)) + 1


def test_true_bounds_help(device):
    scene = enclosure(30, 0.9)
    S = IdentityPlus(Dense(device, scene.R))
    b = random.normal(size=scene.n)
    spectrum = np.linalg.eigvalsh(scene.S)
    b -= b.mean()  # nothing of the dominant eigenvector, whose eigenvalue is ten times the next
    free = ltcl.solve(S, b, "chebyshev", rtol=1e-3)
    tight = ltcl.solve(S, b, "chebyshev", rtol=1e-3, spectrum=(spectrum[0], spectrum[-2]))
    assert tight.products < free.products
    assert tight.products <= theory.chebyshev_products(spectrum[0], spectrum[-2], 1e-3) + 1


@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
@pytest.mark.parametrize("arnoldi", [2, 3, 5])
@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_a_few_arnoldi_steps_lose_no_products(device, arnoldi, rho, rtol):
    """They solve as well as they measure."""
    scene = lambertian(60, rho, 9, density=0.3)
    S = IdentityPlus(Dense(device, scene.R))
    b = random.uniform(size=(60, 2))
    free = ltcl.solve(S, b, "chebyshev", rtol=rtol, arnoldi=0)
    refined = ltcl.solve(S, b, "chebyshev", rtol=rtol, arnoldi=arnoldi)
    assert residual(scene.S, refined.x, b) <= rtol * (1 + 1e-2)
    assert refined.products <= free.products + 1


ALBEDOS = (0.5, 0.8, 0.92, 0.95, 0.99)
DUALS = ("forward", "inverse")
ONE_WAY = {("jacobi", "inverse"), ("neumann", "inverse")}  # below an albedo of 1/2 only (eq. 14)
# Either end may leave out eigenvalues.
WRONG = [
    (0.5, 2.0),
    (0.3, 1.2),
    (0.9, 1.1),
    (0.04, 0.9),
    (1.5, 4.0),
]
CASES = [
    *(
        (*case, 6, None)
        for case in itertools.product((*ITERATIVE, "auto"), DUALS)
        if case not in ONE_WAY
    ),
    *itertools.product(["chebyshev"], DUALS, (2, 3), [None]),
    *itertools.product(["chebyshev"], DUALS, [6], WRONG),
]


@functools.cache
def room(albedo: float, dual: str, sides: int = 6) -> tuple[np.ndarray, tuple[float, float]]:
    """I - A or its inverse, and its least and largest eigenvalue."""
    forward = np.eye(6 * 6 * sides) - np.asarray(ltcl.scenes.box(6, sides, albedo).A, np.float64)
    S = forward if dual == "forward" else np.linalg.inv(forward)
    eigenvalues = np.linalg.eigvals(S).real
    return S, (float(eigenvalues.min()), float(eigenvalues.max()))


def pictures(n: int) -> list[np.ndarray]:
    rng = np.random.default_rng(11)
    columns = rng.normal(size=(n, 3)) * (1.0, 0.0, 1.0) + (0.0, 0.0, 1.0)
    return [np.ones(n), rng.normal(size=n), np.eye(n)[n // 3], columns]


@pytest.mark.slow
@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize(("method", "dual", "sides", "bounds"), CASES)
def test_every_method_passes_both_ways(device, method, dual, albedo, sides, bounds):
    """Chebyshev by at most half as many products again as with the true spectrum, and two to learn
    by; wrong bounds are repaired, and not slower than plain damping by far."""
    S, (least, most) = room(albedo, dual, sides)
    options = {} if bounds is None else {"spectrum": bounds}
    A = as_operator(S, device)
    # The slowest, to a tenth of rtol.
    budget = theory.richardson_products(least, 2.0 * most, 1e-3) + 3
    if bounds is not None:
        budget = 2 * theory.chebyshev_products(*theory.free_bounds(A), 1e-4) + 30
    elif method == "chebyshev":
        budget = 1.5 * theory.chebyshev_products(least, most, 1e-2) + 2
    for b in pictures(len(S)):
        s = ltcl.solve(as_operator(S, device), b, method, **options)
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= budget
        assert len(s.residuals) == s.iterations + 1 or method == "auto"
