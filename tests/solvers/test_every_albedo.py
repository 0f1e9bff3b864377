# SPDX-License-Identifier: BSD-3-Clause
"""Every method passes both ways: bounces added and undone, at every albedo, of pictures of every kind."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

import ltcl
from ltcl import theory
from ltcl.operators import as_operator
from tests.problems import residual
from tests.solvers.helpers import ITERATIVE

ALBEDOS = (0.5, 0.8, 0.92, 0.95, 0.99)
DUALS = ("forward", "inverse")
ONE_WAY = {("jacobi", "inverse"), ("neumann", "inverse")}  # below an albedo of 1/2 only (eq. 14)
CASES = [case for case in itertools.product((*ITERATIVE, "auto"), DUALS) if case not in ONE_WAY]


@functools.cache
def room(n: int, sides: int, albedo: float) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """I - A, its inverse, and the least and largest eigenvalue of A."""
    A = np.asarray(ltcl.scenes.box(n, sides, albedo).A, np.float64)
    forward = np.eye(len(A)) - A
    eigenvalues = np.linalg.eigvals(A).real
    return forward, np.linalg.inv(forward), (float(eigenvalues.min()), float(eigenvalues.max()))


def pictures(n: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(11)
    spot = np.zeros(n)
    spot[n // 3] = 1.0
    return {
        "even": np.ones(n),
        "uniform": rng.uniform(size=n),
        "normal": rng.normal(size=n),
        "spot": spot,
        "with a dark column": rng.normal(size=(n, 3)) * (1.0, 0.0, 1.0) + (0.0, 0.0, 1.0),
    }


def spectrum(dual: str, ends: tuple[float, float]) -> tuple[float, float]:
    least, most = ends
    return (1.0 - most, 1.0 - least) if dual == "forward" else (1.0 / (1.0 - least), 1.0 / (1.0 - most))


@pytest.mark.parametrize("sides", [2, 3, 6])
@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize("dual", DUALS)
def test_chebyshev_takes_at_most_half_as_many_again_as_with_the_true_spectrum(device, dual, albedo, sides):
    forward, inverse, ends = room(6, sides, albedo)
    S = forward if dual == "forward" else inverse
    wanted = theory.chebyshev_products(*spectrum(dual, ends), 1e-2)
    for name, b in pictures(len(S)).items():
        s = ltcl.solve(as_operator(S, device), b, "chebyshev")
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= 1.5 * wanted + 2, name  # two to learn by, where a picture gains nothing from it


@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize(("method", "dual"), CASES)
def test_every_method_passes_both_ways(device, method, dual, albedo):
    forward, inverse, ends = room(6, 6, albedo)
    S = forward if dual == "forward" else inverse
    least, most = spectrum(dual, ends)
    budget = theory.richardson_products(least, 2.0 * most, 1e-3)  # the slowest of them, to a tenth of rtol
    for name, b in pictures(len(S)).items():
        s = ltcl.solve(as_operator(S, device), b, method)
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= budget + 3, name


@pytest.mark.parametrize("bounds", [(0.5, 2.0), (0.3, 1.2), (0.9, 1.1), (0.04, 0.9), (1.5, 4.0)])
@pytest.mark.parametrize("albedo", ALBEDOS)
@pytest.mark.parametrize("dual", DUALS)
def test_wrong_bounds_are_repaired(device, dual, albedo, bounds):
    """Either end may leave out eigenvalues; what is found cannot be slower than plain damping by far."""
    forward, inverse, ends = room(6, 6, albedo)
    S = forward if dual == "forward" else inverse
    free = theory.chebyshev_products(*theory.free_bounds(as_operator(S, device)), 1e-4)
    for name, b in pictures(len(S)).items():
        s = ltcl.solve(as_operator(S, device), b, "chebyshev", spectrum=bounds)
        assert residual(S, s.x, b) <= 1e-2 * (1 + 1e-3)
        assert s.products <= 2 * free + 30, (name, s.products, ends)
