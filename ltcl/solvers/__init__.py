# SPDX-License-Identifier: BSD-3-Clause
"""Solvers of S x = b: one family of methods per file, one stopping rule, one result."""

from __future__ import annotations

from ltcl.solvers.bounded import Bounded
from ltcl.solvers.inverse import Inverse
from ltcl.solvers.matrix_series import matrix_series
from ltcl.solvers.problem import LinearProblem, SolveSettings
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.solve import METHODS, solve, solve_each

__all__ = [
    "METHODS",
    "Bounded",
    "Inverse",
    "LinearProblem",
    "Solution",
    "SolveSettings",
    "Status",
    "matrix_series",
    "solve",
    "solve_each",
]
