# SPDX-License-Identifier: BSD-3-Clause
"""The stopping rule: claims are computed from x itself, and no failure is silent."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import Dense, IdentityPlus, as_operator, base
from ltcl.solvers import Solution, Status
from tests.problems import enclosure, lambertian, residual
from tests.solvers.helpers import ITERATIVE, failed, slow_cases, small_blocks

random = np.random.default_rng(10)


@pytest.mark.slow
@pytest.mark.parametrize("method", ITERATIVE)
@pytest.mark.parametrize("rtol", [0.3, 1e-2, 1e-5, 1e-6, *slow_cases(1e-4, 3e-8, 1e-10)])
@pytest.mark.parametrize("rho", [0.5, 0.97, *slow_cases(0.1, 0.9)])
def test_converged_is_true_of_x_and_met_down_to_rounding(device, method, rtol, rho):
    scene = lambertian(64, rho, seed=11)
    b = random.uniform(0.0, 1.0, (64, 5)) * np.logspace(-4, 4, 5)
    R = IdentityPlus(Dense(device, scene.R))  # rounded to float32
    sparse = scipy.sparse.csr_array(scene.S)
    for S, rounding in ((R, 2**-22), (scene.S, 1e-2 * rtol), (sparse, 1e-2 * rtol)):
        s = ltcl.solve(S, b, method, rtol=rtol, throw=False)
        assert s.converged or rtol < 1e-5
        if s.converged:
            assert residual(scene.S, s.x, b) <= rtol * (1 + 1e-3) + rounding
            assert s.residual <= rtol
        # Residuals of cg and bicgstab rise and fall between two readings.
        if method not in ("cg", "bicgstab") and rtol > 1e-6:
            assert all(value > rtol for value in s.residuals[:-1])


@pytest.mark.parametrize("method", ITERATIVE)
def test_a_recomputed_residual_forgets_the_way_of_x_before_it(device, monkeypatch, method):
    """Claims near rounding take few products even without float64 to decide them."""
    scene = lambertian(64, 0.5, seed=11)
    S = IdentityPlus(Dense(device, scene.R))
    b = np.random.default_rng(0).uniform(size=64)
    options = small_blocks(method)
    cheap = ltcl.solve(S, b, method, rtol=1e-6, **options)
    monkeypatch.setattr(base, "CHEAP_PRODUCT_BYTES", 0)
    s = ltcl.solve(S, b, method, rtol=1e-6, throw=False, **options)
    assert s.status is Status.CONVERGED
    assert s.products <= 1.5 * cheap.products


@pytest.mark.parametrize("method", ITERATIVE)
def test_maxiter_ends_it_with_the_best_iterate(device, method):
    scene = lambertian(64, 0.9, seed=12)
    S = IdentityPlus(Dense(device, scene.R))
    b = random.uniform(0.0, 1.0, 64)
    s = failed(S, b, method, rtol=1e-6, maxiter=2, **small_blocks(method))
    assert (s.status, s.iterations, len(s.residuals)) == (Status.MAXITER, 2, 3)
    assert residual(scene.S, s.x, b) == pytest.approx(min(s.residuals), rel=1e-2)


@pytest.mark.parametrize("method", ITERATIVE)
def test_below_the_floor_of_float32_it_stagnates(device, method):
    scene = lambertian(64, 0.5, seed=13)
    b = random.uniform(0.0, 1.0, 64)
    s = failed(IdentityPlus(Dense(device, scene.R)), b, method, rtol=1e-10)
    assert s.status is Status.STAGNATED
    assert s.iterations < 200
    assert residual(scene.S, s.x, b) < 1e-5


# <b, S b> = 0 for b = (1, 1)
TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])
SIGNS = np.diag([1.0, -1.0])
# Float32 holds these to the bit.
whole = np.random.default_rng(0).integers(-9, 9, (6, 6)).astype(float)
SINGULAR = {
    "to the bit": np.array([[1.0, 2.0], [2.0, 4.0]]),
    "a zero row": np.diag([1.0, 0.0, 1.0]),
    # The last pivot is 1e-15, not 0.
    "to rounding": np.vstack([whole[:5], whole[0] + whole[1] - whole[2]]),
}
# Far beyond what any splitting takes, not self-adjoint.
LARGE = np.full((6, 6), 9.0) - 8.0 * np.eye(6)
LARGE[0] *= (1, -1, -1, -1, -1, -1)
# I - S S~^-1 is 1 - 6 / 2 at one pixel
FAR = np.diag([6.0, 0.8, 0.8])
NEAR = np.diag([2.0, 0.8, 0.8])
ENDS: dict[str, tuple[Any, Any, str, Status, dict[str, Any]]] = {  # S, b, method, its end, options
    "negative": (np.diag([-1.0, -2.0, -3.0]), np.ones(3), "cg", Status.INDEFINITE, {}),
    "singular": (np.diag([0.0, 1.0, 2.0]), [1.0, 0.0, 0.0], "cg", Status.INDEFINITE, {}),
    "turn": (TURN, [1.0, 1.0], "cg", Status.INDEFINITE, {}),
    "no direction": (np.diag([0.0, 1.0]), [1.0, 1.0], "gmres", Status.BREAKDOWN, {}),
    "nilpotent": ([[0.0, 1.0], [0.0, 0.0]], [1.0, 0.0], "gmres", Status.BREAKDOWN, {}),
    "turn, BiCGStab": (TURN, [1.0, 1.0], "bicgstab", Status.NO_STEP, {}),
    "signs": (SIGNS, [1.0, 1.0], "bicgstab", Status.NO_STEP, {}),
    "ring": (
        np.eye(30) + 3.0 * np.roll(np.eye(30), 1, axis=1),
        None,
        "chebyshev",
        Status.DIVERGED,
        {},
    ),
    "large": (LARGE, np.ones(6), "gauss_seidel", Status.DIVERGED, {}),
    # fig. 5c.
    "neither falls nor grows": (
        enclosure(30, 0.5).S,
        np.ones(30),
        "jacobi",
        Status.STAGNATED,
        {},
    ),
    "start beyond float32": (
        *(np.eye(6) + np.triu(np.full((6, 6), 10.0)), np.ones(6), "neumann", Status.DIVERGED),
        {"x0": np.full(6, 1e6)},
    ),
    "below float64": (
        lambertian(60, 4.0).S,
        np.ones(60),
        "direct",
        Status.STAGNATED,
        {"rtol": 1e-30},
    ),
    "refined by Jacobi": (
        np.diag([1.5, 0.8, 0.8]),
        np.ones(3),
        "jacobi",
        Status.DIVERGED,
        {"exact": FAR},
    ),
    "refined": (NEAR, np.ones(3), "gmres", Status.DIVERGED, {"exact": FAR}),
    "refined by LU": (NEAR, np.ones(3), "direct", Status.DIVERGED, {"exact": FAR}),
    "a step diverges": (
        np.diag([1.0, 3.5]),
        np.ones(2),
        "jacobi",
        Status.DIVERGED,
        {"exact": np.eye(2)},
    ),
    "a step is singular": (
        SINGULAR["a zero row"],
        None,
        "direct",
        Status.BREAKDOWN,
        {"exact": np.eye(3)},
    ),
} | {
    f"{name}, {method}": (S, None, method, Status.BREAKDOWN, {})
    for name, S in SINGULAR.items()
    for method in ("direct", "auto")
}


@pytest.mark.parametrize("case", ENDS)
def test_it_ends_with_an_x_no_worse_than_none_and_what_it_advises_works(device, case):
    S, b, method, status, options = ENDS[case]
    S = np.array(S, float)
    b = random.uniform(0.5, 1.0, len(S)) if b is None else np.array(b)
    s = failed(as_operator(S, device), b, method, **{"rtol": 1e-5} | options)
    assert s.status is status
    assert s.x.shape == b.shape
    if "x0" not in options:
        assert residual(options.get("exact", S), s.x, b) <= 1.0 + 1e-6
    if status in (Status.INDEFINITE, Status.NO_STEP) and np.linalg.det(S):
        assert ltcl.solve(as_operator(S, device), b, "gmres", rtol=1e-5).converged


@pytest.mark.parametrize("signs", [1.0, (-1.0) ** np.arange(8)], ids=["Inf", "NaN"])
@pytest.mark.parametrize("method", ITERATIVE)
def test_overflow_is_divergence(device, method, signs):
    """Products beyond float32 give Inf, or Inf - Inf, which no comparison may take for small."""
    S = np.where(np.eye(8) == 1, 1.0, 3e38 * signs * np.ones((8, 8)))
    options = small_blocks(method, 1)  # of two rows and more, blocks are singular in float64
    s = ltcl.solve(as_operator(S, device), np.full(8, 1.9), method, throw=False, **options)
    # GMRES multiplies S with unit directions only; with signs that cancel, those products stay in
    # float32.
    assert s.status is Status.DIVERGED or (method == "gmres" and np.ndim(signs))
    assert np.isfinite(s.x).all()


@pytest.mark.parametrize("method", ITERATIVE)
def test_overflow_midway_leaves_the_best_iterate(device, method):
    """The second step multiplies the first by 3.3e38, so that the residual leaves float32."""
    S = np.eye(8)
    S[1, 2] = 0.9
    S[0, 1] = 3.3e38
    S[4, 5] = 0.2
    b = 1.9 * np.eye(8)[2] + 1.5 * np.eye(8)[5]
    s = failed(as_operator(S, device), b, method, **small_blocks(method, 1))
    assert s.status in (Status.DIVERGED, Status.STAGNATED)  # damped by 1e-38, nothing moves at all
    assert s.status is Status.DIVERGED or method == "richardson"
    assert residual(S, s.x, b) == pytest.approx(s.residual, rel=1e-5)
    if method in ("jacobi", "neumann", "gauss_seidel", "sor"):
        assert s.residual < 0.9


@pytest.mark.parametrize("method", ITERATIVE)
@pytest.mark.parametrize("size", [1e3, 1e37])
def test_starts_far_off(device, method, size):
    """Squares of the larger leave float32: said, and nothing is claimed."""
    scene = enclosure(30, 0.3)
    b = random.uniform(size=(30, 3))
    x0 = size * random.uniform(0.5, 1.0, size=(30, 3))
    s = ltcl.solve(as_operator(scene.S, device), b, method, x0=x0, rtol=1e-3, throw=False)
    assert s.converged == (size == 1e3)
    assert not s.converged or residual(scene.S, s.x, b) <= 1e-3 * (1 + 1e-2)


FAILURES = [status for status in Status if status not in (Status.CONVERGED, Status.PRECOMPUTED)]


@pytest.mark.parametrize(
    "method", ["jacobi", "richardson", "southwell", "chebyshev", "gmres", "bicgstab"]
)
@pytest.mark.parametrize("status", FAILURES)
def test_every_failure_says_what_to_try_instead(status, method):
    solution = Solution(
        x=np.zeros(3),
        status=status,
        iterations=3,
        products=4,
        residuals=(1.0, 0.5, 0.7),
        method=method,
    )
    text = str(solution)
    assert re.search(f"{method}.*{status.name.lower()}.* 3 .* 4 .* 0.5", text)
    assert any(word in text for word in ("try ", "check ", "loosen "))
    assert "\n" not in text
    assert ("spectral radius" in text) == (status is Status.DIVERGED and method == "jacobi")
    if status in (Status.DIVERGED, Status.STAGNATED):
        assert f"'{method}'" not in text
        assert text.endswith("'direct'")
