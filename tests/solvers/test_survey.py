# SPDX-License-Identifier: BSD-3-Clause
"""What three products tell of S, against its eigenvalues."""

from __future__ import annotations

import gc
import math
import weakref

import numpy as np
import pytest

import ltcl
from ltcl.operators import Dense, IdentityPlus
from ltcl.solvers import auto as survey
from ltcl.solvers.auto import Survey
from tests.problems import enclosure, lambertian


@pytest.mark.parametrize("rho", [0.1, 0.8, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_the_spectrum_of_a_diffuse_scene_is_held(device, seed, rho):
    scene = lambertian(300, rho, seed, density=0.2)
    found = survey.survey(IdentityPlus(Dense(device, scene.R), weights=scene.weights))
    eigenvalues = np.linalg.eigvals(scene.S).real
    lower, upper = found.spectrum
    assert upper >= eigenvalues.max() * (1 - 1e-3)
    # Single ones a little below the rest may be missed: one product more, not a divergence.
    assert lower <= np.quantile(eigenvalues, 0.02)
    assert found.imaginary < 0.02
    assert found.defect < 1e-3
    assert found.products == survey.STEPS


@pytest.mark.parametrize(("skew", "wanted"), [(0.0, 0.0), (1.0, 1.0), (0.5, np.sqrt(0.5))])
def test_the_defect_is_the_part_that_turns(device, skew, wanted):
    """(1 - s) M + s K of symmetric M and antisymmetric K of equal size."""
    random = np.random.default_rng(3).normal(size=(2, 300, 300)) / 300
    M, K = random[0] + random[0].T, random[1] - random[1].T
    found = survey.survey(IdentityPlus(Dense(device, (1 - skew) * M + skew * K)))
    assert found.defect == pytest.approx(wanted, abs=1e-3 if skew in (0.0, 1.0) else 0.3)


def test_weights_make_it_self_adjoint(device):
    scene = lambertian(300, 0.8, seed=4)
    assert survey.survey(IdentityPlus(Dense(device, scene.R), weights=scene.weights)).defect < 1e-5
    assert survey.survey(IdentityPlus(Dense(device, scene.R))).defect > 0.05


@pytest.mark.parametrize("rho", [0.5, 0.8, 4.0])
@pytest.mark.parametrize("rtol", [1e-2, 1e-3])
def test_krylov_methods_take_what_was_foreseen(device, rho, rtol):
    scene = lambertian(300, rho, seed=5)
    S = IdentityPlus(Dense(device, scene.R))
    foreseen = survey.survey(S).krylov_products(rtol)
    b = np.random.default_rng(6).uniform(size=300)
    assert abs(ltcl.solve(S, b, "gmres", rtol=rtol).products - foreseen) <= 1


def test_one_that_stalls_is_foreseen_to_take_for_ever():
    assert Survey(np.ones(1), (1.0, 1.0), (1.0, 1.0), 0.0, 1).krylov_products(0.1) == math.inf


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_smallest_systems(device, n):
    found = survey.survey(IdentityPlus(Dense(device, np.diag(np.arange(n) / 4.0))))
    assert len(found.ritz) == n
    assert found.defect < 1e-6
    np.testing.assert_allclose(np.sort(np.real(found.ritz)), 1.0 + np.arange(n) / 4.0, atol=1e-3)


def test_it_lives_as_long_as_its_operator(device):
    S = IdentityPlus(Dense(device, enclosure(20, 0.5).R))
    assert survey.survey(S) is survey.survey(S)
    gone = weakref.ref(S)
    del S
    gc.collect()
    assert gone() is None
