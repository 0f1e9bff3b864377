# SPDX-License-Identifier: BSD-3-Clause
"""`auto` chooses a method before the first step and says why; its survey shows the spectrum."""

from __future__ import annotations

import gc
import re
import weakref

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.solvers import auto
from tests.bases import rotation
from tests.problems import lambertian, residual
from tests.solvers.helpers import failed

N = auto.SMALL + 8


@pytest.fixture(autouse=True)
def usual_speeds(monkeypatch):
    """Choices by time are those of a usual machine, not of one that other tests keep busy."""
    monkeypatch.setenv("LTCL_TUNE", "0")
    for name in ("_overheads", "_bandwidth", "_flops"):
        monkeypatch.setattr(auto, name, getattr(auto, name).__wrapped__)


def ring(gain: float, skew: float = 0.0) -> np.ndarray:
    """R that passes light on to both neighbours on a ring, unevenly by `skew`; rho(R) = |gain|."""
    right = np.roll(np.eye(N), 1, axis=1)
    return gain / 2 * ((1 + skew) * right + (1 - skew) * right.T)


def system(device, R):
    return IdentityPlus(CSR(device, scipy.sparse.csr_array(R)))


def normal(eigenvalues: np.ndarray) -> np.ndarray:
    """(N, N), normal, with these real eigenvalues, seen from a random orthonormal basis."""
    Q = rotation(N, 1)
    return (Q * np.resize(eigenvalues, N)) @ Q.T


def pictures(*columns: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(size=(N, *columns))


CANCEL = np.outer((-1.0) ** np.arange(N), (-1.0) ** np.arange(N)) / N  # row sums 0, rho 1
CHOICES = {
    "small": (np.eye(20) + 0.01, 1e-2, "direct", "20"),
    "precise": (np.eye(N) + ring(0.01), 1e-9, "jacobi", "float64, since rtol=1e-09"),
    "weak": (
        np.eye(N) + ring(0.01),
        1e-2,
        "jacobi",
        r"jacobi: 1 product, chebyshev: 4 .*R .* 0.01$",
    ),
    "strong": (
        np.eye(N) + ring(0.5),
        1e-2,
        "chebyshev",
        r"first: chebyshev: .*cg: .*by 3 products$",
    ),
    "lopsided": (np.eye(N) + ring(0.5, 0.3), 1e-2, "chebyshev", r"first: chebyshev: .*gmres: "),
    "three eigenvalues": (
        *(normal(np.where(np.arange(N) < 2, [3.0, 6.0] * (N // 2), 1.0)), 1e-2, "cg gmres"),
        r"gmres: 3 .*chebyshev: \d+ .* 1 and 6 by 3 products$|cg: 4 ",
    ),
    "indefinite": (normal(np.linspace(-1, 3, N)), 0.2, "gmres", r"gmres: \d+ products.* between -"),
    "one-way": (
        np.eye(N) + ring(0.7, 1.0),
        1e-2,
        "gmres",
        r"0.5\d of R .* imaginary parts up to 0.\d+ by 3",
    ),
    "rows that cancel": (
        np.eye(N) + 3 * CANCEL,
        1e-2,
        "cg gmres",
        "^jacobi: .*; jacobi ended diverged; ",
    ),
}


@pytest.mark.parametrize("case", CHOICES)
def test_the_choice_and_its_reason(device, case):
    S, rtol, method, why = CHOICES[case]
    b = np.random.default_rng(0).uniform(size=len(S))
    A = system(device, S - np.eye(len(S)))
    first, s = (ltcl.solve(A, b, rtol=rtol) for _ in range(2))
    assert s.method in method.split(), s.reason
    assert re.search(why, s.reason), s.reason
    assert first.products <= s.products + auto.STEPS + 2  # which went on where gmres had come to
    assert ("gmres ended maxiter" in first.reason) == (case in ("one-way", "indefinite"))
    assert max(residual(S, x, b) for x in (first.x, s.x)) <= max(rtol, 1e-6) * (1 + 1e-3)


@pytest.mark.slow
def test_a_first_solve_needs_no_survey_and_the_second_makes_one_for_good(device):
    """The products of a survey count in the solve that made it alone; factors live as long as S."""
    S = system(device, ring(0.5))
    first, second, third = (ltcl.solve(S, pictures()) for _ in range(3))
    assert (first.method, first.products) == ("gmres", ltcl.solve(S, pictures(), "gmres").products)
    assert "eigenvalues" not in first.reason
    # Worth it at once.
    assert "eigenvalues" in ltcl.solve(system(device, ring(0.5)), pictures(20)).reason
    assert second.products == third.products + auto.STEPS
    np.testing.assert_array_equal(second.x, third.x)
    ltcl.solve(S, pictures(), "direct")
    gone = weakref.ref(S)
    del S
    gc.collect()
    assert gone() is None


def test_many_right_hand_sides_are_worth_a_factorization_and_one_is_not(device):
    S = IdentityPlus(Dense(device, ring(0.9)))
    methods = [next(auto.plan(S, 1e-2, k)).method.name for k in (4000, 1)]
    assert methods[1] != methods[0] == "direct"
    ltcl.solve(S, pictures(), "direct")
    assert ltcl.solve(S, pictures(3), rtol=1e-5).method == "direct"  # by factors that are there


def test_where_a_method_has_no_room_the_next_is_tried(device, monkeypatch):
    S = system(device, ring(0.7, 1.0))
    b = pictures()
    assert ltcl.solve(S, b).method == "gmres"
    # Bytes: three directions of the survey, not twenty.
    monkeypatch.setattr(device, "memory", 40_000)
    s = ltcl.solve(S, b)
    assert (s.method, "gmres failed" in s.reason) == ("direct", True)
    assert residual(np.eye(N) + ring(0.7, 1.0), s.x, b) <= 1e-2


def test_where_nothing_converges_it_raises_with_the_best_iterate(device, monkeypatch):
    """A singular S that the picture is not in the range of."""
    monkeypatch.setattr(auto, "LARGEST_DIRECT", N - 1)
    S = normal(np.linspace(-1.0, 3.0, 9) * (np.arange(9) != 4))
    b = pictures()
    s = failed(system(device, S - np.eye(N)), b)
    assert s.reason.endswith("gmres ended stagnated")
    assert residual(S, s.x, b) == pytest.approx(s.residual, rel=1e-2)
    assert s.residual < 0.6  # 1/3 of the light is out of reach


@pytest.mark.parametrize("rho", [0.1, 0.5, 0.8, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_survey_of_a_diffuse_scene_holds_its_spectrum_and_foresees_gmres(device, seed, rho):
    scene = lambertian(300, rho, seed, density=0.2)
    b = np.random.default_rng(6).uniform(size=300)
    S, plain = (
        IdentityPlus(Dense(device, scene.R), weights=weights) for weights in (scene.weights, None)
    )
    seen = auto.survey(S)
    eigenvalues = np.linalg.eigvals(scene.S).real
    assert seen.spectrum[1] >= eigenvalues.max() * (1 - 1e-3)
    # Single ones a little below the rest may be missed: one product more, not a divergence.
    assert seen.spectrum[0] <= np.quantile(eigenvalues, 0.02)
    assert seen.in_an_interval
    assert seen.defect < 1e-3
    assert auto.survey(plain).defect > 0.02 * rho / (1 + rho)
    for rtol in (1e-2, 1e-3):
        assert abs(ltcl.solve(S, b, "gmres", rtol=rtol).products - seen.krylov_products(rtol)) <= 1


@pytest.mark.parametrize(("skew", "defect"), [(0.0, 0.0), (1.0, 1.0), (0.5, np.sqrt(0.5))])
def test_the_defect_is_the_part_that_turns(device, skew, defect):
    """(1 - s) M + s K of symmetric M and antisymmetric K of equal size."""
    random = np.random.default_rng(3).normal(size=(2, 300, 300)) / 300
    M = random[0] + random[0].T
    K = random[1] - random[1].T
    seen = auto.survey(IdentityPlus(Dense(device, (1 - skew) * M + skew * K)))
    assert seen.defect == pytest.approx(defect, abs=1e-3 if skew in (0.0, 1.0) else 0.3)
