# SPDX-License-Identifier: BSD-3-Clause
"""Products with S that each method takes to 1 %, from dim rooms to bright ones.

Closed boxes of one albedo m, where rho(R) = m / (1 - m); an open corner of albedo 0.9; and a glossy
corner, whose S of one camera is not self-adjoint. A third of the pixels has random direct light.
Every solution is checked in float64. A sweep of Gauss-Seidel counts as a product, and so do as many
rows of Southwell's method as there are pixels; a factorization takes none. The choice of `auto`,
and times, are in solve.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table

import ltcl
from _harness import Options, parse_options, publish
from ltcl.scenes import box, dihedral, glossy
from ltcl.solvers.solve import METHODS, SAMPLED
from solve import RTOL, Problem

RADII = (0.8, 1.5, 4.0, 9.0)
CORNER_ALBEDO = 0.9
# One of the rooms of gloss.py.
GLOSS = [0.4, 0.4]
GLOSSY_ROOM = {"exponent": 20, "projector": (2.4, 1.2, 1.2)}


def problem(name: str, scene: Any, options: Options) -> Problem:
    """S of a scene with its true first bounce, and a picture of it."""
    (S,) = scene.transport(first_bounce=scene.first_bounce, device=options.device).systems
    n = S.shape[0]
    R = S.to_dense() - np.eye(n, dtype=np.float32)
    is_lit = np.arange(n) < n / 3
    l_d = np.random.default_rng(1).random(n, dtype=np.float32) * is_lit
    return Problem(name, R, S, l_d + R @ l_d)


def rooms(smoke: bool) -> dict[str, Any]:
    """Scenes by their names in the table."""
    n, directions = (4, 16) if smoke else (16, 64)
    scenes: dict[str, Any] = {}
    for rho in RADII:
        scenes[f"rho {rho:g}"] = box(n, sides=6, albedo=rho / (1.0 + rho))
    scenes["corner"] = box(n, sides=3, albedo=CORNER_ALBEDO)
    scenes["glossy"] = glossy(dihedral(1), n, 0.5, GLOSS, directions=directions, **GLOSSY_ROOM)
    return scenes


def products(problem: Problem, method: str) -> int | str:
    """Products that a method takes, or how it ended."""
    solution = ltcl.solve(problem.S, problem.b, method, rtol=RTOL, throw=False)
    if not solution.converged:
        return solution.status.name.lower()
    problem.check(method, solution.x)
    return solution.products


def main() -> None:
    options = parse_options(__doc__)
    problems = [problem(name, room, options) for name, room in rooms(options.smoke).items()]
    table = Table("method", *(room.name for room in problems))
    counts: dict[str, dict[str, int | str]] = {}
    for method in METHODS:
        if method in SAMPLED or method == "auto":
            continue
        counts[method] = {room.name: products(room, method) for room in problems}
        table.add_row(method, *map(str, counts[method].values()))
    pixels = {f"pixels, {room.name}": len(room.b) for room in problems}
    publish(options, "Products to 1 %", pixels, table, {"products": counts})


if __name__ == "__main__":
    main()
