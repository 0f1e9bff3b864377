# SPDX-License-Identifier: BSD-3-Clause
"""Chebyshev: no more products than theory says; and all methods at every albedo, bounces added and undone."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import Status
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import ITERATIVE

random = np.random.default_rng(8)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
@pytest.mark.parametrize("rho", [0.5, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_closed_room_takes_no_more_products_than_the_bound(device, seed, rho, rtol):
    """S is symmetric with spectrum in [1 / (1 + m), 1 + rho], so the bound on the residual is strict."""
    scene = enclosure(40, rho / (1 + rho), seed)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=(scene.n, 3))
    s = ltcl.solve(S, b, "chebyshev", rtol=rtol)
    assert residual(scene.S, s.x, b) <= rtol * (1 + 1e-3)
    assert s.products <= theory.chebyshev_products(0.5, 1 + rho, rtol) + 1  # one for rounding at the edge
    if rho == 4.0 and rtol == 1e-2:
        assert s.products <= 8


@pytest.mark.parametrize("rtol", [1e-2, 1e-5])
@pytest.mark.parametrize("rho", [50.0, 200.0])
@pytest.mark.parametrize("seed", range(8))
def test_residuals_that_swing_are_not_taken_for_trouble(device, seed, rho, rtol):
    """Up to an albedo of 0.995; a residual close to 0 by chance is neither a floor nor a start of growth."""
    scene = lambertian(60, rho, seed, density=0.3)
    S = IdentityPlus(Dense(device, scene.R))
    b = scene.S @ random.uniform(0.0, 1.0, scene.n)
    s = ltcl.solve(S, b, "chebyshev", rtol=rtol)
    # The bound holds in the area / albedo norm, whose weights differ by 3 at most.
    assert s.products <= theory.chebyshev_products(*theory.free_bounds(S), rtol / np.sqrt(3)) + 1


def test_true_bounds_help(device):
    scene = enclosure(30, 0.9)
    S, b = IdentityPlus(Dense(device, scene.R)), random.normal(size=scene.n)
    spectrum = np.linalg.eigvalsh(scene.S)
    b -= b.mean()  # nothing of the dominant eigenvector, whose eigenvalue is ten times the next
    free = ltcl.solve(S, b, "chebyshev", rtol=1e-3)
    tight = ltcl.solve(S, b, "chebyshev", rtol=1e-3, spectrum=(spectrum[0], spectrum[-2]))
    assert tight.products < free.products
    assert tight.products <= theory.chebyshev_products(spectrum[0], spectrum[-2], 1e-3) + 1


def test_where_no_interval_helps_it_diverges(device):
    """A one-way ring of gain 3: eigenvalues all around the origin."""
    S = np.eye(30) + 3.0 * np.roll(np.eye(30), 1, axis=1)
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(as_operator(S, device), random.uniform(size=30), "chebyshev")
    assert caught.value.solution.status is Status.DIVERGED


@pytest.mark.parametrize("rho", [0.8, 4.0, 9.0])
@pytest.mark.parametrize("arnoldi", [2, 3, 5])
@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_a_few_arnoldi_steps_lose_no_products(device, arnoldi, rho, rtol):
    """They solve as well as they measure."""
    scene = lambertian(60, rho, 9, density=0.3)
    S, b = IdentityPlus(Dense(device, scene.R)), random.uniform(size=(60, 2))
    free = ltcl.solve(S, b, "chebyshev", rtol=rtol, arnoldi=0)
    refined = ltcl.solve(S, b, "chebyshev", rtol=rtol, arnoldi=arnoldi)
    assert residual(scene.S, refined.x, b) <= rtol * (1 + 1e-2)
    assert refined.products <= free.products + 1


@pytest.mark.parametrize("arnoldi", [-1, 1, 1.5, "few"])
def test_an_unusable_number_of_arnoldi_steps_is_refused(arnoldi):
    with pytest.raises(InputError, match=r"arnoldi is .* [02]"):
        ltcl.solve(np.eye(3), np.ones(3), "chebyshev", arnoldi=arnoldi)


@pytest.mark.parametrize(
    "bounds",
    [(0.0, 1.0), (-1.0, 1.0), (2.0, 1.0), (1.0,), 3.0, "ab", (0.5, np.inf), (np.nan, 1.0), (1.0, "b")],
)
def test_unusable_bounds_are_refused(bounds):
    with pytest.raises(InputError, match="spectrum"):
        ltcl.solve(np.eye(3), np.ones(3), "chebyshev", spectrum=bounds)


ALBEDOS = (0.5, 0.8, 0.92, 0.95, 0.99)
DUALS = ("forward", "inverse")
ONE_WAY = {("jacobi", "inverse"), ("neumann", "inverse")}  # below an albedo of 1/2 only (eq. 14)
CASES = [case for case in itertools.product((*ITERATIVE, "auto"), DUALS) if case not in ONE_WAY]


@functools.cache
def room(albedo: float, dual: str, sides: int = 6) -> tuple[np.ndarray, tuple[float, float]]:
    """I - A or its inverse, and its least and largest eigenvalue."""
    forward = np.eye(6 * 6 * sides) - np.asarray(ltcl.scenes.box(6, sides, albedo).A, np.float64)
    S = forward if dual == "forward" else np.linalg.inv(forward)
    eigenvalues = np.linalg.eigvals(S).real
    return S, (float(eigenvalues.min()), float(eigenvalues.max()))


def pictures(n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(11)
    return {
        "even": np.ones(n),
        "normal": rng.normal(size=n),
        "spot": np.eye(n)[n // 3],
        "with a dark column": rng.normal(size=(n, 3)) * (1.0, 0.0, 1.0) + (0.0, 0.0, 1.0),
    }


@pytest.mark.parametrize("sides", [2, 3, 6])
@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize("dual", DUALS)
def test_it_takes_at_most_half_as_many_products_again_as_with_the_true_spectrum(device, dual, albedo, sides):
    S, spectrum = room(albedo, dual, sides)
    for name, b in pictures(len(S)).items():
        s = ltcl.solve(as_operator(S, device), b, "chebyshev")
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= 1.5 * theory.chebyshev_products(*spectrum, 1e-2) + 2, name  # two to learn by


@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize(("method", "dual"), CASES)
def test_every_method_passes_both_ways(device, method, dual, albedo):
    S, (least, most) = room(albedo, dual)
    budget = theory.richardson_products(least, 2.0 * most, 1e-3)  # the slowest of them, to a tenth of rtol
    for name, b in pictures(len(S)).items():
        s = ltcl.solve(as_operator(S, device), b, method)
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= budget + 3, name


@pytest.mark.parametrize("bounds", [(0.5, 2.0), (0.3, 1.2), (0.9, 1.1), (0.04, 0.9), (1.5, 4.0)])
@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize("dual", DUALS)
def test_wrong_bounds_are_repaired(device, dual, albedo, bounds):
    """Either end may leave out eigenvalues; the outcome cannot be slower than plain damping by far."""
    S, _ = room(albedo, dual)
    free = theory.chebyshev_products(*theory.free_bounds(as_operator(S, device)), 1e-4)
    for name, b in pictures(len(S)).items():
        s = ltcl.solve(as_operator(S, device), b, "chebyshev", spectrum=bounds)
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= 2 * free + 30, (name, s.products)
        assert len(s.residuals) == s.iterations + 1
