# SPDX-License-Identifier: BSD-3-Clause
"""Methods and systems of the tables of this folder, and the two ways in which a solve can fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import LinearOperator

import ltcl
from ltcl.device import Device
from ltcl.device.kernels import Kernel
from ltcl.errors import ConvergenceError, InputError
from ltcl.operators import CSR, Compressed, IdentityPlus
from ltcl.solvers import METHODS as ALL
from ltcl.solvers import Solution, Status
from tests.bases import MatrixBasis, rotation, stands_for, two_sided
from tests.problems import Scene, enclosure

SAMPLED = ("monte_carlo", "hybrid")
# Methods that keep a tolerance.
METHODS = tuple(method for method in ALL if method not in SAMPLED)
ITERATIVE = tuple(method for method in METHODS if method not in ("direct", "auto"))
# Methods that refuse an operator without rows.
READS_ROWS = ("gauss_seidel", "sor", "block_gauss_seidel", "southwell")
# pixels of compressed systems, and coefficients where not all are there
N = 43
SOME = 19
CLOSED = enclosure(N, 0.4)  # self-adjoint in the plain inner product, and so on coefficients


def by_products(n: int, act: Callable[[np.ndarray], Any], **more: Any) -> LinearOperator:
    """S, (n, n), known by products alone, without its transpose; `more` is given to SciPy."""
    parts: dict[str, Any] = {"shape": (n, n), "matvec": act, "matmat": act, "dtype": np.float64}
    return LinearOperator(**parts | more)


def slow_cases(*values: Any) -> list[Any]:
    """Parameters of a table that run in CI alone."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def small_blocks(method: str, block: int = 4) -> dict[str, Any]:
    """Options for a small N, of which one block of all rows would be solved at once."""
    return {"block": block} if method == "block_gauss_seidel" else {}


def force_groups(monkeypatch: Any, device: Device, group: int) -> None:
    """Let all kernels run with work-groups of one size, as far as the device allows it."""
    # What was planned for other groups does not fit these.
    monkeypatch.setattr(device.session, "reductions", {})
    real = Kernel.group

    def forced(kernel: Kernel, wanted: Any) -> Any:
        wanted = group if isinstance(wanted, int) else tuple(min(n, group) for n in wanted)
        return real(kernel, wanted)

    monkeypatch.setattr(Kernel, "group", forced)


def refused(
    says: str, S: Any, b: Any, method: str = "auto", kind: Any = InputError, **options: Any
) -> str:
    """The message, of one line, with which `solve` refuses this."""
    with pytest.raises(kind, match=says) as caught:
        ltcl.solve(S, b, method, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def failed(S: Any, b: Any, method: str = "auto", **options: Any) -> Solution:
    """The best iterate of a solve that has to fail."""
    with pytest.raises(ConvergenceError) as caught:
        ltcl.solve(S, b, method, **options)
    s = caught.value.solution
    assert not s.converged
    assert s.status is not Status.SAMPLED
    assert np.isfinite(s.x).all()
    assert "\n" not in str(caught.value)
    return s


def compressed(
    device: Device, scene: Scene = CLOSED, keep: float = 0.6, **options: Any
) -> tuple[IdentityPlus, np.ndarray]:
    """S = I + R with R in a basis that turns all pixels, and its float64 matrix."""
    R = two_sided(device, scene.R, keep)
    return IdentityPlus(R, **options), np.eye(N) + stands_for(R)


def subset(device: Device, sign: float = 1.0) -> tuple[IdentityPlus, np.ndarray]:
    """S = I + sign V^T C V with 19 of 43 coefficients, and its float64 matrix."""
    # Row sums are near the spectrum, as free bounds suppose.
    V = MatrixBasis(device, rotation(N, 6)[:SOME])
    scene = enclosure(SOME, 0.4)
    R = Compressed(CSR(device, scipy.sparse.csr_array(scene.R if sign > 0 else scene.A)), V, V)
    return IdentityPlus(R, sign), np.eye(N) + sign * stands_for(R)
