# SPDX-License-Identifier: BSD-3-Clause
"""Block Gauss-Seidel is that of the textbook, between Gauss-Seidel and the direct solution."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.solvers import Status
from tests import reference
from tests.problems import enclosure, lambertian, residual

FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
SCENE = lambertian(53, rho=0.8, seed=2, density=0.6)
DUALS = {"inverse": (SCENE.R, 1), "forward": (SCENE.A, -1)}
random = np.random.default_rng(3)


@pytest.mark.parametrize("block", [1, 7, 32, 53])
@pytest.mark.parametrize("sweeps", [1, 2, 5])
@pytest.mark.parametrize("dual", DUALS)
@pytest.mark.parametrize("form", FORMATS)
def test_k_iterations_are_k_sweeps(device, form, dual, sweeps, block):
    matrix, sign = DUALS[dual]
    b = random.uniform(0.0, 1.0, (SCENE.n, 5))
    x0 = random.normal(size=b.shape)
    S = np.eye(SCENE.n) + sign * matrix
    A = IdentityPlus(FORMATS[form](device, matrix), sign)
    options = {"block": block, "x0": x0, "rtol": 1e-7, "atol": 1e-30, "maxiter": sweeps}
    s = ltcl.solve(A, b, "block_gauss_seidel", **options, throw=False)
    wanted = reference.block_gauss_seidel(S, x0, b, block, s.iterations)
    assert s.iterations == sweeps or s.residual < 1e-6
    # Each sweep rounds a sum of n float32 products; inverses of blocks are no larger than S^-1 here.
    np.testing.assert_allclose(s.x, wanted, rtol=0, atol=sweeps * SCENE.n * 2**-24 * np.abs(wanted).max())
    assert s.residuals[-1] == pytest.approx(residual(S, wanted, b), rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("dual", DUALS)
@pytest.mark.parametrize("form", FORMATS)
def test_blocks_of_one_row_are_gauss_seidel(device, form, dual):
    matrix, sign = DUALS[dual]
    A, b = IdentityPlus(FORMATS[form](device, matrix), sign), random.uniform(0.0, 1.0, SCENE.n)
    one = ltcl.solve(A, b, "block_gauss_seidel", block=1, rtol=1e-4)
    other = ltcl.solve(A, b, "gauss_seidel", rtol=1e-4)
    assert one.iterations == other.iterations
    np.testing.assert_allclose(one.x, other.x, rtol=0, atol=1e-5)


@pytest.mark.parametrize("block", [53, 1000])
@pytest.mark.parametrize("dual", DUALS)
@pytest.mark.parametrize("form", FORMATS)
def test_one_block_is_the_direct_solution(device, form, dual, block):
    matrix, sign = DUALS[dual]
    S, b = np.eye(SCENE.n) + sign * matrix, random.uniform(0.0, 1.0, (SCENE.n, 3))
    A = IdentityPlus(FORMATS[form](device, matrix), sign)
    s = ltcl.solve(A, b, "block_gauss_seidel", block=block, rtol=1e-5)
    assert s.iterations == 1
    np.testing.assert_allclose(s.x, np.linalg.solve(S, b), rtol=0, atol=1e-5 * float(np.linalg.norm(b)))


@pytest.mark.parametrize("rho", [1.5, 4.0, 9.0])
@pytest.mark.parametrize(
    "make", [lambda rho: enclosure(40, rho / (1 + rho)), lambda rho: lambertian(40, rho)]
)
def test_it_converges_where_jacobi_diverges(device, make, rho):
    scene = make(rho)
    S, b = IdentityPlus(Dense(device, scene.R)), scene.S @ random.uniform(0.0, 1.0, scene.n)
    assert ltcl.solve(S, b, "jacobi", throw=False).status is Status.DIVERGED
    s = ltcl.solve(S, b, "block_gauss_seidel", block=8, rtol=1e-3)
    assert residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-3)


def test_pixels_that_light_each_other_within_blocks_need_one_sweep(device):
    """Blocks that do not see each other: what Gauss-Seidel iterates on, the inverses hold."""
    scenes = [lambertian(8, 4.0, seed) for seed in range(4)]
    S, b = scipy.linalg.block_diag(*(scene.S for scene in scenes)), random.uniform(0.0, 1.0, 32)
    A = CSR(device, scipy.sparse.csr_array(S))
    assert ltcl.solve(A, b, "block_gauss_seidel", block=8, rtol=1e-5).iterations == 1
    assert ltcl.solve(A, b, "gauss_seidel", rtol=1e-5).iterations > 5


def test_products_are_sweeps_one_to_look_back_and_one_to_confirm(device):
    S, b = IdentityPlus(Dense(device, SCENE.R)), random.uniform(0.0, 1.0, SCENE.n)
    s = ltcl.solve(S, b, "block_gauss_seidel", rtol=1e-3, block=8)
    assert s.products == s.iterations + 2


@pytest.mark.parametrize("block", [0, -1, 2.5, "all", None, np.nan])
def test_an_unusable_block_is_refused(block):
    with pytest.raises(InputError, match=r"^block is .*; it must be a whole number of at least 1$"):
        ltcl.solve(np.eye(3), np.ones(3), "block_gauss_seidel", block=block)


@pytest.mark.parametrize("form", FORMATS)
def test_a_singular_block_is_refused_by_rows(device, form):
    """S has an inverse, its second block has none."""
    S = np.eye(5)
    S[2:4, 2:4] = [[1.0, 2.0], [2.0, 4.0]]
    S[2, 4] = S[4, 2] = 1.0
    assert np.linalg.matrix_rank(S) == 5
    with pytest.raises(
        InputError, match=r"block 1, rows 2 to 3, is singular; choose another block="
    ) as caught:
        ltcl.solve(FORMATS[form](device, S), np.ones(5), "block_gauss_seidel", block=2)
    assert "\n" not in str(caught.value)
