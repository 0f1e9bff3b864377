# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: every method on every operator, compressed and refined ones, in any unit of light."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.operators import CSR, Dense, Host, IdentityPlus, as_operator
from ltcl.solvers.solve import KINDS
from tests.problems import lambertian, residual
from tests.solvers.helpers import (
    ALL,
    CLOSED,
    ITERATIVE,
    METHODS,
    READS_ROWS,
    N,
    by_products,
    compressed,
    refused,
    subset,
)

SCENE = lambertian(N, rho=0.6, density=0.7)
DUALS = {"inverse": SCENE.S, "forward": np.eye(N) - SCENE.A}
random = np.random.default_rng(1)


FORMS = {
    "dense": Dense,
    "csr": lambda device, S: CSR(device, scipy.sparse.csr_array(S)),
    "host": lambda device, S: Host(device, by_products(N, lambda x: S @ x)),
    "identity plus csr": lambda device, S: IdentityPlus(FORMS["csr"](device, S - np.eye(N))),
    "identity minus dense": lambda device, S: IdentityPlus(Dense(device, np.eye(N) - S), sign=-1),
    "identity minus host": lambda device, S: IdentityPlus(
        Host(device, aslinearoperator(np.eye(N) - S)), -1
    ),
}


def far_from_exact(device) -> tuple[IdentityPlus, np.ndarray, dict[str, Any]]:
    """Half of the coefficients; refined against all."""
    exact = np.eye(N) + CLOSED.R
    S, truth = compressed(device, keep=0.5)
    error = float(np.linalg.norm(np.linalg.inv(truth), 2) * np.linalg.norm(truth - exact, 2))
    assert 1e-3 < error < 0.5
    return IdentityPlus(S.R, solution_error=error), exact, {"exact": exact, "rtol": 1e-5}


# S, the same in float64, and options. The slack is float32 rounding of S, and of both transforms.
SYSTEMS: dict[str, tuple[Callable[[Any], tuple[Any, ...]], float]] = {
    f"{kind}, {dual}": (lambda device, make=make, S=S: (make(device, S), S, {}), 1e-3)
    for kind, make in FORMS.items()
    for dual, S in DUALS.items()
}
SYSTEMS |= {
    "all coefficients": (lambda device: (*compressed(device), {}), 2e-2),
    "some coefficients": (lambda device: (*subset(device), {}), 2e-2),
    "some, forward": (lambda device: (*subset(device, -1.0), {}), 2e-2),
    "refined": (far_from_exact, 5e-2),
}


@pytest.mark.parametrize("columns", [(), (1,), (5,)])
@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_on_every_operator(device, method, name, columns):
    """S^-1 removes all bounces and (I - A)^-1 adds them: the same call (eq. 4 and 7)."""
    make, slack = SYSTEMS[name]
    A, S, options = make(device)
    options = {"rtol": 1e-4} | options
    b = random.uniform(0.0, 1.0, (N, *columns))
    if method in READS_ROWS and "host" in name:
        refused(f"'{method}'.*Host", A, b, method)
        return
    seen: list[tuple[int, float]] = []
    s = ltcl.solve(A, b, method, **options, callback=lambda *step: seen.append(step))
    assert seen == list(enumerate(s.residuals))
    assert s.converged
    assert s.method == ("direct" if method == "auto" else method)
    assert s.x.shape == b.shape
    assert residual(S, s.x, b) <= options["rtol"] * (1 + slack)
    exact = np.linalg.solve(S, b)
    assert np.linalg.norm(s.x - exact) <= options["rtol"] * np.linalg.cond(S) * np.linalg.norm(
        exact
    )
    assert len(s.residuals) == s.iterations + 1
    # A part is solved at once.
    assert s.residuals[0] == pytest.approx(1.0, rel=1e-5) or "some" in name


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e25])
def test_units_of_light_do_not_matter(device, method, scale):
    """Squares of these values leave float32; each column keeps its own tolerance."""
    S = as_operator(SCENE.S, device)
    b = random.uniform(0.5, 1.0, (N, 4)) * (1.0, 1e-5, 1e5, 0.0) * scale
    s = ltcl.solve(S, b, method, rtol=1e-4)
    assert residual(SCENE.S, s.x.astype(np.float64) / scale, b / scale) <= 1e-4 * (1 + 1e-3)
    assert not s.x[:, 3].any()
    s = ltcl.solve(S, b[:, 0], method, rtol=0.0, atol=1e-3 * scale)
    left = b[:, 0] / scale - SCENE.S @ (s.x.astype(np.float64) / scale)
    assert np.linalg.norm(left) <= 1e-3 * (1 + 1e-3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [1e38, 1e200])
def test_light_beyond_float32_is_not_lost(device, method, size):
    b = np.array([3.0, 2.0]) * size
    s = ltcl.solve(as_operator(np.diag([0.25, 0.5]), device), b, method, rtol=1e-4)
    assert s.x.dtype == np.float64
    np.testing.assert_allclose(s.x, b * (4.0, 2.0), rtol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_without_light_x_is_0_and_takes_no_iteration(device, method):
    """It holds for any start, whose residual underflows, and for a singular S."""
    s = ltcl.solve(as_operator(SCENE.S, device), np.zeros((N, 2)), method)
    assert s.converged
    assert not s.x.any()
    assert s.residual == 0.0
    assert method in ("direct", "auto") or s.iterations == 0
    x0 = np.array([[1e-24, 0.6], [1e-24, 0.7]])
    s = ltcl.solve(1.5 * np.eye(2), np.array([[0.0, 1.0], [0.0, 1.0]]), method, x0=x0)
    assert not s.x[:, 0].any()
    assert ltcl.solve(1.5 * np.eye(2), np.zeros(2), method, x0=x0[:, 0]).x.tolist() == [0.0, 0.0]
    if method in ("direct", "auto"):
        assert ltcl.solve(np.ones((2, 2)), np.zeros(2), method).x.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("method", ITERATIVE)
def test_a_start_at_the_solution_ends_there(device, method):
    b = random.uniform(0.0, 1.0, (N, 5))
    exact = np.linalg.solve(SCENE.S, b)
    s = ltcl.solve(as_operator(SCENE.S, device), b, method, x0=exact, rtol=1e-4)
    assert s.converged
    assert s.iterations == 0
    np.testing.assert_array_equal(s.x, exact.astype(np.float32))


def test_a_solution_shows_itself_in_one_line(device):
    s = ltcl.solve(np.eye(N), np.ones((N, 1000)), "gmres")
    assert re.fullmatch(
        r"<ltcl Solution of 43 x 1000 values by gmres: converged after .*>", repr(s)
    )


@pytest.mark.parametrize("method", [method for method in ALL if method not in ("direct", "auto")])
def test_help_tells_the_options_of_every_method(method):
    _, _, notes = (ltcl.solve.__doc__ or "").partition("Notes\n")
    assert re.search(rf"\b{method}\b", notes)
    for option in dataclasses.fields(KINDS[method]):
        assert re.search(rf"\b{option.name}[:,]", notes), option.name
