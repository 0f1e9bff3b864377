# SPDX-License-Identifier: BSD-3-Clause
"""Three colours solved as one system, where launches take longer than products do.

    diag(S_1, S_2, S_3) x = b,    b = (b_1 / ||b_1||, ...)

Between coefficients a product is a few numbers, and most of the time of a solve are its launches,
of which one system needs a third. Each channel keeps its own tolerance: with c channels that have
light, a residual of rtol / sqrt(c) of the whole is below rtol in each.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl.operators import Operator
from ltcl.operators.colour_hats import share_entries
from ltcl.operators.diagonal_blocks import are_quicker_joined, joined_once
from ltcl.solvers.auto import SMALL, solve_automatically
from ltcl.solvers.problem import LinearProblem, SolveSettings
from ltcl.solvers.result import Solution

# Below, a solve may be refined in float64, channel by channel.
MIN_JOINED_RTOL = 1e-4


def may_join(
    systems: Sequence[Any], sides: Sequence[Any], settings: SolveSettings, x0: Any
) -> bool:
    """True if one solve of all channels is quicker, and no less than three."""
    if len(systems) < 2 or x0 is not None or settings.callback is not None or settings.atol:
        return False
    if settings.rtol < MIN_JOINED_RTOL:
        return False
    if any(np.ndim(side) > 1 and np.shape(side)[1] != 1 for side in sides):
        return False
    for S in systems:
        is_small = not isinstance(S, Operator) or S.shape[0] <= SMALL
        if is_small or S.device is not systems[0].device:
            return False
    if any(S.coefficient_basis is None for S in systems) and not share_entries(systems):
        return False
    return are_quicker_joined(systems)


def solve_joined(
    systems: Sequence[Operator], sides: Sequence[np.ndarray], settings: SolveSettings
) -> tuple[Solution, ...] | None:
    """The solution of each channel; None if the joined solve did not converge."""
    S = joined_once(systems)
    sizes = [float(np.linalg.norm(side)) for side in sides]
    lit_count = sum(size > 0.0 for size in sizes)
    if not lit_count or not np.all(np.isfinite(sizes)):
        return None
    columns = []
    for side, size in zip(sides, sizes, strict=True):
        columns.append(np.ravel(side) / (size or 1.0))
    b = np.concatenate(columns).astype(np.float32)
    shared = dataclasses.replace(
        settings, rtol=settings.rtol / np.sqrt(lit_count), with_residual=True, throw=False
    )
    solution = solve_automatically(LinearProblem.from_arrays(S, b, shared))
    if not solution.converged or solution.rest is None:
        return None
    xs = np.split(solution.x, len(sides))
    residual_vectors = np.split(solution.rest, len(sides))
    solutions = []
    for x, r, side, size in zip(xs, residual_vectors, sides, sizes, strict=True):
        # Relative to ||b|| of this channel, which is 1 in the joined system.
        residual = float(np.linalg.norm(r))
        rest = None
        if settings.with_residual:
            rest = np.reshape(size * r, np.shape(side))
        solutions.append(
            dataclasses.replace(
                solution,
                x=np.reshape(size * x, np.shape(side)).astype(x.dtype, copy=False),
                rest=rest,
                residuals=(*solution.residuals[:-1], residual),
                lowest=None,
            )
        )
    return tuple(solutions)
