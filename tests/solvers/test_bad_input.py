# SPDX-License-Identifier: BSD-3-Clause
"""`solve` and `matrix_series` refuse bad input, options out of range, and S without a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator

import ltcl
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, LtclError, MemoryLimitError
from ltcl.operators import Dense, IdentityPlus, as_operator
from ltcl.solvers import matrix_series
from tests.solvers.helpers import ALL, SAMPLED, N, by_products, compressed, refused

# Arguments, error, what the message must name and say.
BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "S is not square": ({"S": np.ones((4, 3))}, InputError, r"S has shape \(4, 3\)"),
    "S is a vector": ({"S": np.ones(4)}, InputError, r"S has shape \(4,\)"),
    "S is complex": ({"S": np.eye(4) * 1j}, InputTypeError, "matrix holds complex"),
    "S has NaN": (
        {"S": np.full((4, 4), np.nan)},
        InputError,
        "matrix has 16 NaN or infinite value",
    ),
    "b is short": (
        {"b": np.ones(3)},
        InputError,
        r"b has shape \(3,\).*\(4,\)",
    ),
    "b is a picture": ({"b": np.ones((4, 1, 1))}, InputError, r"b has shape \(4, 1, 1\)"),
    "b is empty": ({"b": np.ones((4, 0))}, InputError, r"b has shape \(4, 0\)"),
    "b is a number": ({"b": 1.0}, InputError, r"b has shape \(\)"),
    "b has NaN": ({"b": [1, 2, np.nan, 4]}, InputError, "b has 1 NaN or infinite value"),
    "b has Inf": ({"b": [1, 2, 3, np.inf]}, InputError, "b has 1 NaN or infinite value"),
    "b is text": ({"b": "light"}, InputTypeError, "b is the text"),
    "method is unknown": (
        {"method": "gauss"},
        InputError,
        "method is 'gauss'; .* jacobi, .*, auto",
    ),
    "method is an array": ({"method": np.ones(2)}, InputError, "method is array"),
    "rtol is zero": ({"rtol": 0.0}, InputError, "rtol is 0; .*or atol above 0"),
    "rtol is negative": ({"rtol": -0.1}, InputError, "rtol is -0.1.* 0"),
    "rtol is one": ({"rtol": 1.0}, InputError, "rtol is 1.0.* 1"),
    "rtol is NaN": ({"rtol": np.nan}, InputError, "rtol is nan"),
    "rtol is text": ({"rtol": "small"}, InputError, "rtol is 'small'"),
    "atol is negative": ({"atol": -1.0}, InputError, "atol is -1.0"),
    "maxiter is zero": ({"maxiter": 0}, InputError, "maxiter is 0"),
    "maxiter is a fraction": ({"maxiter": 2.5}, InputError, "maxiter is 2.5"),
    "x0 is short": ({"x0": np.ones(3)}, InputError, r"x0 has shape \(3,\).*\(4,\)"),
    "x0 has NaN": ({"x0": [np.nan] * 4}, InputError, "x0 has 4 NaN or infinite value"),
    "callback is a number": ({"callback": 3}, InputTypeError, "callback is 3"),
    "S is a transport": (
        {"S": ltcl.Transport(np.eye(4), (2, 2))},
        InputTypeError,
        "S.*T.interreflection",
    ),
    "unknown option": ({"light": 3}, InputTypeError, "unknown option 'light'"),
    "no option, but of others": (
        {"with_residual": True},
        InputTypeError,
        "unknown option 'with_residual'",
    ),
    "no option, but a class variable": ({"name": "x"}, InputTypeError, "unknown option 'name'"),
    "of another method": (
        {"restart": 3, "arnoldi": 2},
        InputTypeError,
        "one of method=.(chebyshev|gmres)",
    ),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("method", ALL)
def test_bad_input_is_refused_by_name_before_anything_is_allocated(monkeypatch, method, case):
    change, error, says = BAD[case]
    if "matrix" not in says:  # which the operator itself checks
        monkeypatch.setattr(Device, "empty", lambda *_, **__: pytest.fail("allocated"))
    arguments: dict[str, Any] = {"S": np.eye(4), "b": np.ones(4), "method": method} | change
    refused(says, arguments.pop("S"), arguments.pop("b"), kind=error, **arguments)


COUNTS = [0, -1, 2.5, "all", np.nan]
DAMPING = [0.0, -1.0, np.inf, np.nan, "fast", [1.0]]
OPTIONS: dict[tuple[str, str], list[Any]] = {
    ("gauss_seidel", "block"): COUNTS,
    ("sor", "block"): COUNTS,
    ("block_gauss_seidel", "block"): [*COUNTS, None],
    ("southwell", "rows"): COUNTS,
    ("gmres", "restart"): [*COUNTS, None],
    ("richardson", "omega"): DAMPING,
    ("sor", "omega"): [*DAMPING, 2.0],
    ("chebyshev", "arnoldi"): [-1, 1, 1.5, "few"],
    ("chebyshev", "spectrum"): [
        *[
            (0.0, 1.0),
            (-1.0, 1.0),
            (2.0, 1.0),
            (1.0,),
            3.0,
            "ab",
            (0.5, np.inf),
            (np.nan, 1.0),
            (1.0, "b"),
        ]
    ],
    ("cg", "weights"): [np.ones(4), [1.0, 0.0, -1.0], [1.0, np.nan, 1.0], "area"],
    ("monte_carlo", "samples"): [0, 0.5, 1 << 32],
    ("monte_carlo", "seed"): [-1, 1 << 64],
    ("monte_carlo", "albedo"): [-0.2, 0.5],
    ("monte_carlo", "error"): [0.0],
    ("monte_carlo", "pixels"): [[0, 3], [-1, 2], [], [[1], [2, 3]], [0.5]],
    ("monte_carlo", "gather"): [3],
    ("hybrid", "samples"): [0],
}


@pytest.mark.parametrize(("method", "option"), OPTIONS)
def test_an_unusable_option_is_refused_with_its_value(method, option):
    for value in OPTIONS[method, option]:
        says = f"{option} .*{value}" if isinstance(value, (int, float)) else option
        refused(
            says, np.eye(3), np.ones(3), method, (InputError, InputTypeError), **{option: value}
        )


def product_of(result: Callable[[np.ndarray], Any]) -> LinearOperator:
    return by_products(2, lambda x: result(np.array([[2.0, 0.5], [0.5, 1.0]]) @ x))


HALF = IdentityPlus(as_operator(np.eye(3) / 2))
BLUE = np.pad(np.full((1, 3), np.nan), ((2, 0), (0, 0)))
ROWLESS = IdentityPlus(as_operator(aslinearoperator(np.eye(3) / 2)))
PAIR = np.eye(5)  # has an inverse, its second block of two has none
PAIR[2:4, 2:4] = [[1.0, 2.0], [2.0, 4.0]]
PAIR[2, 4] = PAIR[4, 2] = 1.0
HUGE = IdentityPlus(as_operator(np.outer([0.0, 0.0, 1.0], [2e38] * 3)))
ONE = np.ones(3)
HOLE = np.diag([1.0, 1.0, 0.0])
MC = "monte_carlo"
Row = tuple[Any, Any, str, dict[str, Any], type[LtclError], str]
TWO = {"block": 2}
SINGULAR_BLOCK = "block_gauss.* 2 to 3 .*block"
NO_STEPS: list[Row] = [
    *((S, np.ones(5), "block_gauss_seidel", TWO, InputError, SINGULAR_BLOCK)
      for S in (PAIR, scipy.sparse.csr_array(PAIR))),
    *((form(HOLE), ONE, method, {}, InputError, rf"'{method}'.*diagonal.* 1 row.* row 2")
      for form in (np.asarray, scipy.sparse.csr_array) for method in ("gauss_seidel", "southwell")),
    *((HUGE, ONE, method, {}, InputError, "R.*row 2.*float32") for method in SAMPLED),
    *((ROWLESS, ONE, method, {}, InputError, f"{method}.*Host") for method in SAMPLED),
    *((product_of(result), np.ones(2), method, {}, InputTypeError, "the product of")
      for method in ("auto", "direct", "gmres")
      for result in (lambda y: (1 + 5j) * y, lambda y: np.ma.masked_less(y, 2.0))),
]  # fmt: skip
TOGETHER: list[Row] = [
    (HALF, ONE, MC, {"series": "chebyshev"}, InputTypeError, "series.*monte_carlo.*albedo"),
    (HALF, ONE, MC, {"gather": True, "pixels": [1]}, InputTypeError, "gather.*pixels"),
    (HALF, ONE, MC, {"adjoint": True, "pixels": [1]}, InputTypeError, "adjoint.*pixels"),
    (HALF, ONE, MC, {"adjoint": True, "error": 0.1}, InputTypeError, "adjoint.*error"),
    (HALF, ONE, MC, {"adjoint": True, "samples": 1 << 31}, InputError, "samples.*2147483648"),
    (HALF, ONE, MC, {"exact": HALF}, InputTypeError, "'monte_carlo'"),
    (HALF, ONE, "hybrid", {"adjoint": True}, InputTypeError, "adjoint.*hybrid"),
    (HALF, ONE, "jacobi", {"omega": 0.5}, InputTypeError, "omega.*richardson"),
    (HALF, ONE, "auto", {"exact": np.eye(4)}, InputError, r"exact.*\(4, 4\)"),
    (HALF, ONE, "auto", {"exact": np.full((3, 3), np.nan)}, InputError, "NaN"),
    (HALF, ONE, "auto", {"exact": "T.npz"}, InputTypeError, "exact is"),
    (
        HALF,
        ONE,
        "auto",
        {"exact": ltcl.Transport(np.eye(3), (1, 3))},
        InputTypeError,
        "T.interreflection",
    ),
]
COLOUR: list[Row] = [
    ((HALF,) * 3, ONE, MC, {}, InputError, r"b.*\(3,\).*\(3, 3\)"),
    ((HALF,) * 3, np.ones((2, 3)), MC, {}, InputError, r"b.*\(2, 3\)"),
    ((HALF,) * 3, BLUE, MC, {}, InputError, "channel 2.*b.*3"),
    ((HALF,) * 3, np.ones((3, 3)), "cg", {}, InputTypeError, "S is 3 operators"),
    ((HALF,) * 2, np.ones((2, 3)), MC, {}, InputTypeError, "S is 2 operators"),
    ((HALF,) * 3, np.ones((3, 3)), MC, {"light": 1}, InputTypeError, "'light'"),
    ((HALF,) * 3, np.ones((3, 3)), MC, {"pixels": [3]}, InputError, "pixels.*3"),
]


@pytest.mark.parametrize(
    ("S", "b", "method", "options", "kind", "says"), [*NO_STEPS, *TOGETHER, *COLOUR]
)
def test_what_does_not_go_together_is_refused(S, b, method, options, kind, says):
    refused(says, S, b, method, kind, **options)


def test_exact_on_another_device_is_refused(device, small_device):
    exact = Dense(small_device, np.eye(N))
    refused(r"exact.*another device", compressed(device)[0], np.ones(N), exact=exact)


def test_a_tolerance_below_the_error_of_solutions_is_refused(device):
    S, _ = compressed(device, solution_error=0.00421)
    b = np.ones((N, 2))
    refused(r"rtol is 1e-05; .* 0.0043.*exact=", S, b, "jacobi", rtol=1e-5)
    assert ltcl.solve(S, b, rtol=0.0043).converged  # what the message asks for
    refused(r"rtol is 0 and atol 0.001; ", S, b, rtol=0.0, atol=1e-3)
    assert ltcl.solve(S, b, rtol=0.0, atol=1.0).converged
    assert not ltcl.solve(S, 0 * b, rtol=1e-5).x.any()
    refused("inf", compressed(device, solution_error=np.inf)[0], b, rtol=0.9)


def test_directions_that_do_not_fit_are_refused_with_their_sizes(device, monkeypatch):
    S = as_operator(scipy.sparse.csr_array(scipy.sparse.eye_array(5000) * 2.0), device)
    monkeypatch.setattr(device, "memory", 10_000_000)
    refused(r"restart=1000\b.*1001", S, np.arange(5000.0), "gmres", MemoryLimitError, restart=10**9)


def test_bad_input_of_the_matrix_series():
    for options in ({"rtol": 0.0}, {"steps": -1}, {"maxiter": 0}, {"S": np.ones((2, 3))}):
        ((name, value),) = options.items()
        says = f"{name} has shape" if name == "S" else f"{name} is {value}"
        with pytest.raises(InputError, match=says):
            matrix_series(**{"S": np.eye(2), **options})
