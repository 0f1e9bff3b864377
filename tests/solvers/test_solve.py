# SPDX-License-Identifier: BSD-3-Clause
"""`solve`: every method on every operator, and the bad input that all methods refuse alike."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.operators import CSR, Dense, Host, IdentityPlus, as_operator
from ltcl.solvers import Solution, Status, precision
from ltcl.solvers.solve import KINDS
from tests.problems import lambertian, residual
from tests.solvers.helpers import ALL, ITERATIVE, METHODS, READS_ROWS

OPERATORS = {
    "dense": Dense,
    "csr": lambda device, S: CSR(device, scipy.sparse.csr_array(S)),
    "host": lambda device, S: Host(device, aslinearoperator(S)),
    "identity plus csr": lambda device, S: IdentityPlus(OPERATORS["csr"](device, S - np.eye(len(S)))),
    "identity minus dense": lambda device, S: IdentityPlus(Dense(device, np.eye(len(S)) - S), sign=-1),
    "identity minus host": lambda device, S: IdentityPlus(OPERATORS["host"](device, np.eye(len(S)) - S), -1),
}
SCENE = lambertian(43, rho=0.6, density=0.7)
DUALS = {"inverse": SCENE.S, "forward": np.eye(SCENE.n) - SCENE.A}
random = np.random.default_rng(1)


@pytest.mark.parametrize("columns", [(), (1,), (5,)])
@pytest.mark.parametrize("dual", DUALS)
@pytest.mark.parametrize("operator", OPERATORS)
@pytest.mark.parametrize("method", METHODS)
def test_every_method_on_every_operator(device, method, operator, dual, columns):
    """S^-1 removes all bounces and (I - A)^-1 adds them: the same call (eq. 4 and 7)."""
    S, b = DUALS[dual], random.uniform(0.0, 1.0, (SCENE.n, *columns))
    A = OPERATORS[operator](device, S)
    if method in READS_ROWS and "host" in operator:
        with pytest.raises(InputError, match=f"'{method}'.*Host"):
            ltcl.solve(A, b, method)
        return
    s = ltcl.solve(A, b, method, rtol=1e-4)
    assert s.converged
    assert s.x.shape == b.shape
    assert residual(S, s.x, b) <= 1e-4 * (1 + 1e-3)  # the slack is float32 rounding of S
    exact = np.linalg.solve(S, b)
    assert np.linalg.norm(s.x - exact) <= 1e-4 * np.linalg.cond(S) * np.linalg.norm(exact)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e25])
def test_units_of_light_do_not_matter(device, method, scale):
    """Squares of these values leave float32; each column keeps its own tolerance, and a dark one is dark."""
    b = random.uniform(0.5, 1.0, (SCENE.n, 4)) * (1.0, 1e-5, 1e5, 0.0) * scale
    s = ltcl.solve(as_operator(SCENE.S, device), b, method, rtol=1e-4)
    assert residual(SCENE.S, s.x.astype(np.float64) / scale, b / scale) <= 1e-4 * (1 + 1e-3)
    assert not s.x[:, 3].any()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("size", [1e38, 1e200])
def test_light_beyond_float32_is_not_lost(device, method, size):
    b = np.array([3.0, 2.0]) * size
    s = ltcl.solve(as_operator(np.diag([0.25, 0.5]), device), b, method, rtol=1e-4)
    assert s.x.dtype == np.float64
    np.testing.assert_allclose(s.x, b * (4.0, 2.0), rtol=1e-3)


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize("method", METHODS)
def test_atol_is_absolute(device, method, scale):
    b = random.uniform(0.5, 1.0, SCENE.n) * scale
    s = ltcl.solve(as_operator(SCENE.S, device), b, method, rtol=0.0, atol=1e-3 * scale)
    left = b / scale - SCENE.S @ (s.x.astype(np.float64) / scale)
    assert np.linalg.norm(left) <= 1e-3 * (1 + 1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_no_light_needs_no_iteration(device, method):
    s = ltcl.solve(as_operator(SCENE.S, device), np.zeros((SCENE.n, 2)), method)
    assert s.converged
    assert not s.x.any()
    assert s.residual == 0.0
    assert method in ("direct", "auto") or s.iterations == 0


@pytest.mark.parametrize("method", ITERATIVE)
def test_a_start_at_the_solution_ends_there(device, method):
    b = random.uniform(0.0, 1.0, (SCENE.n, 5))
    exact = np.linalg.solve(SCENE.S, b)
    s = ltcl.solve(as_operator(SCENE.S, device), b, method, x0=exact, rtol=1e-4)
    assert s.converged
    assert s.iterations == 0
    np.testing.assert_array_equal(s.x, exact.astype(np.float32))


@pytest.mark.parametrize("method", METHODS)
def test_the_callback_sees_the_history(device, method):
    seen = []
    b = random.uniform(0.0, 1.0, SCENE.n)
    s = ltcl.solve(as_operator(SCENE.S, device), b, method, callback=lambda *step: seen.append(step))
    assert [iteration for iteration, _ in seen] == list(range(s.iterations + 1))
    assert tuple(value for _, value in seen) == s.residuals
    assert seen[0][1] == pytest.approx(1.0, rel=1e-5)


# Bad input: (arguments, error, what the message must name and say).

N = 4
BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "S is not square": ({"S": np.ones((N, 3))}, InputError, r"S has shape \(4, 3\)"),
    "S is a vector": ({"S": np.ones(N)}, InputError, r"S has shape \(4,\)"),
    "S is complex": ({"S": np.eye(N) * 1j}, InputTypeError, "matrix holds complex"),
    "S has NaN": ({"S": np.full((N, N), np.nan)}, InputError, "matrix has 16 NaN or infinite value"),
    "b is short": ({"b": np.ones(3)}, InputError, r"b has shape \(3,\); it must be \(4,\) or \(4, k\)"),
    "b is a picture": ({"b": np.ones((N, 1, 1))}, InputError, r"b has shape \(4, 1, 1\)"),
    "b is empty": ({"b": np.ones((N, 0))}, InputError, r"b has shape \(4, 0\)"),
    "b is a number": ({"b": 1.0}, InputError, r"b has shape \(\)"),
    "b has NaN": ({"b": [1, 2, np.nan, 4]}, InputError, "b has 1 NaN or infinite value"),
    "b has Inf": ({"b": [1, 2, 3, np.inf]}, InputError, "b has 1 NaN or infinite value"),
    "b is text": ({"b": "light"}, InputTypeError, "b is the text"),
    "method is unknown": ({"method": "gauss"}, InputError, "method is 'gauss'; .* jacobi, .*, auto"),
    "rtol is zero": ({"rtol": 0.0}, InputError, "rtol is 0; .*or atol above 0"),
    "rtol is negative": ({"rtol": -0.1}, InputError, "rtol is -0.1.* 0"),
    "rtol is one": ({"rtol": 1.0}, InputError, "rtol is 1.0.* 1"),
    "rtol is NaN": ({"rtol": np.nan}, InputError, "rtol is nan"),
    "rtol is text": ({"rtol": "small"}, InputError, "rtol is 'small'"),
    "atol is negative": ({"atol": -1.0}, InputError, "atol is -1.0"),
    "maxiter is zero": ({"maxiter": 0}, InputError, "maxiter is 0"),
    "maxiter is a fraction": ({"maxiter": 2.5}, InputError, "maxiter is 2.5"),
    "x0 is short": ({"x0": np.ones(3)}, InputError, r"x0 has shape \(3,\); it must be \(4,\)"),
    "x0 has NaN": ({"x0": [np.nan] * N}, InputError, "x0 has 4 NaN or infinite value"),
    "callback is a number": ({"callback": 3}, InputTypeError, "callback is 3"),
    "S is a transport": (
        {"S": ltcl.Transport(np.eye(N), (2, 2))},
        InputTypeError,
        "S is a Transport; give .*T.interreflection",
    ),
    "unknown option": ({"light": 3}, InputTypeError, "unknown option 'light'"),
    "of another method": (
        {"restart": 3, "arnoldi": 2},
        InputTypeError,
        "is one of method=.(chebyshev|gmres)",
    ),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("method", ALL)
def test_bad_input_is_refused_by_name_before_anything_is_uploaded(monkeypatch, method, case):
    change, error, says = BAD[case]
    if "matrix" not in says:  # which the operator itself checks
        monkeypatch.setattr(precision, "as_operator", lambda *_: pytest.fail("uploaded"))
    arguments: dict[str, Any] = {"S": np.eye(N), "b": np.ones(N), "method": method} | change
    with pytest.raises(error, match=says) as caught:
        ltcl.solve(**arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("method", ["jacobi", "richardson", "southwell", "chebyshev", "gmres", "bicgstab"])
@pytest.mark.parametrize("status", [Status.DIVERGED, Status.STAGNATED])
def test_the_advice_is_another_method(method, status):
    said = str(Solution(np.zeros(1), status, 3, 3, (1.0, 200.0), 0.0, method))
    assert f"'{method}'" not in said
    assert said.endswith("'direct'")
    assert ("spectral radius" in said) == (status is Status.DIVERGED and method == "jacobi")


def test_a_solution_shows_itself_in_one_line(device):
    s = ltcl.solve(np.eye(N), np.ones((N, 1000)), "gmres")
    assert re.fullmatch(r"<ltcl Solution of 4 x 1000 values by gmres: converged after .*>", repr(s))


@pytest.mark.parametrize("method", [*ITERATIVE, "monte_carlo", "hybrid"])
def test_help_tells_the_options_of_every_method(method):
    _, _, table = (ltcl.solve.__doc__ or "").partition("method                options")
    assert re.search(rf"\b{method}\b", table)
    for option in dataclasses.fields(KINDS[method]):
        assert re.search(rf"\b{option.name}[:,]", table), option.name
