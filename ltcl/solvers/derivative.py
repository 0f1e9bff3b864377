# SPDX-License-Identifier: BSD-3-Clause
"""The derivative of x = S^-1 b in b: S^-1 itself. Its adjoint is one solve with S^T.

dL/db = S^-T dL/dx, to the tolerance of the solve. By a method that works for S^T as for S: its
spectrum is the same, and so are options that are numbers of the spectrum; others choose "auto".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from ltcl.interop.linear_map import Derivative, LinearMap
from ltcl.operators import Operator
from ltcl.operators.base import Transposed
from ltcl.operators.conversion import as_exact_operator
from ltcl.solvers.problem import check_square
from ltcl.solvers.result import Solution

# Relaxation needs the rows of S, and cg the inner product in which S is self-adjoint.
METHODS_OF_TRANSPOSE = (
    "jacobi",
    "neumann",
    "richardson",
    "chebyshev",
    "gmres",
    "bicgstab",
    "direct",
)
# The arguments of `ltcl.solve` that all methods have.
SHARED_OPTIONS = ("rtol", "maxiter", "throw", "exact")
# Those that are of one right-hand side alone.
OF_ONE_SOLVE = ("x0", "callback", "atol")
# The tolerance where an absolute one alone was given, which says nothing of a derivative.
RTOL_WITHOUT_ATOL = 1e-6


class SolutionDerivative(Derivative):
    """The derivative of a solution in its right-hand side.

    Parameters
    ----------
    S : as `ltcl.solve` takes it
    b : (N,) or (N, k) of the caller's kind
    solve : callable
        `ltcl.solve`.
    method : str
    options : dict
        The further arguments of that solve.
    """

    result_name = "x"

    def __init__(
        self,
        S: Any,
        b: Any,
        solve: Callable[..., Solution],
        method: str,
        options: dict[str, Any],
    ) -> None:
        self.source = b
        self.out_shape = self.shape
        check_square("S", S)
        self._S = S
        self._solve = solve
        self._method = method
        self._options = {k: v for k, v in options.items() if k not in OF_ONE_SOLVE}
        if self._options["rtol"] == 0.0:
            self._options["rtol"] = RTOL_WITHOUT_ATOL

    def linear_map(self, state: np.ndarray | None) -> LinearMap:
        """S^-1, which has no state."""
        return LinearMap(
            shape=self.shape,
            out_shape=self.out_shape,
            forward=self._solutions,
            adjoint=self._solutions_of_transpose,
        )

    @cached_property
    def _system(self) -> Operator:
        if isinstance(self._S, Operator):
            return self._S
        return as_exact_operator(self._S)

    def _solutions(self, sides: np.ndarray) -> np.ndarray:
        return self._solve_columns(self._system, self._method, self._options, sides)

    def _solutions_of_transpose(self, sides: np.ndarray) -> np.ndarray:
        method, options = method_of_transpose(self._method, self._options)
        exact = options.get("exact")
        if exact is not None:
            operator = as_exact_operator(exact, self._system.device)
            options = {**options, "exact": operator.T}
        return self._solve_columns(as_exact_transpose(self._system), method, options, sides)

    def _solve_columns(
        self, S: Operator, method: str, options: dict[str, Any], sides: np.ndarray
    ) -> np.ndarray:
        """The solutions (k, N) or (k, N, columns) of right-hand sides, all in one solve."""
        columns = np.moveaxis(sides, 1, 0)
        x = self._solve(S, columns.reshape(len(columns), -1), method, **options).x
        return np.moveaxis(x.reshape(columns.shape), 0, 1)


def method_of_transpose(method: str, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """The method and options for S^T that go with those for S."""
    if method in METHODS_OF_TRANSPOSE:
        return method, options
    return "auto", {name: value for name, value in options.items() if name in SHARED_OPTIONS}


def as_exact_transpose(S: Operator) -> Operator:
    """S^T; of a compressed S the transpose of what it is, whatever it stands for."""
    # Not S.T: that of a transpose is an operator of somebody else, whose errors stay.
    transpose = Transposed(S)
    transpose.solution_error = 0.0
    transpose.error_bound = 0.0
    return transpose
