# SPDX-License-Identifier: BSD-3-Clause
"""No solve and no task lets a warning of NumPy or SciPy out: failures are a status or an error."""

from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import LtclError
from ltcl.solvers.solve import METHODS

pytestmark = pytest.mark.filterwarnings("error")

N = 12
_rng = np.random.default_rng(3)
_R = 0.5 * _rng.random((N, N)) / N
_B = _rng.uniform(0.1, 1.0, N)
_S = np.eye(N) + _R

# S, b and options of `solve`.
SOLVES: dict[str, tuple[Any, np.ndarray, dict[str, Any]]] = {
    "ordinary": (_S, _B, {}),
    "sparse": (scipy.sparse.csr_array(np.eye(N) + _R * (_R > 0.02)), _B, {}),
    "columns of all sizes": (_S, np.outer(_B, [0.0, 1e-38, 1e-300, 1e38]), {}),
    "largest numbers": (_S, np.full(N, np.finfo(np.float32).max), {}),
    "triangular, far start": (
        np.eye(N) + np.triu(np.full((N, N), 10.0), 1),
        _B,
        {"x0": np.full(N, 1e6)},
    ),
    "grows fast": (np.eye(N) * 1e30, _B, {}),
    "singular": (np.ones((N, N)), _B, {}),
    "zero": (np.zeros((N, N)), _B, {}),
    "nearly singular": (np.eye(N) + np.outer(_B, _B) * -(1 - 1e-9) / (_B @ _B), _B, {"rtol": 1e-8}),
    "far from symmetric": (np.eye(N) + np.roll(np.eye(N), 1, axis=0) * 3.0, _B, {}),
    "tiny": (np.eye(N) * 1e-30, _B, {}),
}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("case", SOLVES)
def test_solves(case, method):
    S, b, options = SOLVES[case]
    if method in ("monte_carlo", "hybrid"):
        options = {**options, "samples": 8}
        options.pop("x0", None)
    try:
        solution = ltcl.solve(S, b, method, throw=False, maxiter=60, **options)
    except LtclError:
        # A refusal is no warning.
        return
    assert solution.x.shape == b.shape


_T = _S * np.linspace(0.4, 0.8, N)
_NEARLY = np.eye(N) + np.outer(_B, _B) * -(1 - 1e-15) / (_B @ _B)
TRANSPORTS = {
    "ordinary": (_T, {}),
    "sparse": (scipy.sparse.csr_array(_T), {}),
    "colour": (np.stack([_T, 0.5 * _T, 0.25 * _T]), {}),
    "masked": (np.where(np.arange(N) == 3, 0.0, _T), {"on_dark": "mask"}),
    "tiny": (_T * 1e-29, {}),
    "subnormal": (_T * 1e-310, {}),
    "large": (_T * 1e36, {}),
    "exact first bounce of a singular T": (_NEARLY, {"first_bounce": "exact"}),
    "rectangular": (_T[: N // 2], {"camera_grid": (2, 3)}),
}
TASKS = {
    "compensate": lambda T, d: ltcl.compensate(T, d),
    "gain": lambda T, d: ltcl.compensate(T, d, gain="auto", loss=0.3),
    "large weights": lambda T, d: ltcl.compensate(T, 9 * d, weights=np.full(d.shape, 1e155)),
    "small weights": lambda T, d: ltcl.compensate(T, 9 * d, weights=np.full(d.shape, 1e-155)),
    "dark picture": lambda T, d: ltcl.compensate(T, 0 * d),
    "bright picture": lambda T, d: ltcl.compensate(T, d * 1e38),
    "faint picture": lambda T, d: ltcl.compensate(T, d * 1e-40),
    "separate": lambda T, d: ltcl.separate(T, d, 2),
    "relight": lambda T, d: ltcl.relight(T, np.full(T.grid, 0.5)),
    "analyze": lambda T, d: ltcl.analyze(T),
    "compress": lambda T, d: ltcl.compress(T, 0.05),
    "invert": lambda T, d: ltcl.invert(T, 0.05),
}


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("case", TRANSPORTS)
def test_tasks(case, task):
    matrix, options = TRANSPORTS[case]
    try:
        T = ltcl.Transport(matrix, (3, 4), **options)
        result = TASKS[task](T, np.resize(_B, T.camera_grid))
    except LtclError:
        return
    for name in ("error", "gap", "clipped"):
        assert np.isfinite(getattr(result, name, 0.0)), name
