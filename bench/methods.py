# SPDX-License-Identifier: BSD-3-Clause
"""Which method when: products with S that each one takes to 1 %, from dim rooms to bright ones.

Closed boxes of one albedo m, where rho(R) = m / (1 - m); an open corner of albedo 0.9; and a glossy
corner, whose S of one camera is not self-adjoint. A third of the pixels has random direct light.
Every solution is checked in float64. A sweep of Gauss-Seidel counts as a product, and so do as many
rows of Southwell's method as there are pixels; a factorization takes none. What `auto` takes, and
times, are in solve.py.
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

RADII, OPEN = (0.8, 1.5, 4.0, 9.0), 0.9
GLOSS, ROOM = [0.4, 0.4], {"exponent": 20, "projector": (2.4, 1.2, 1.2)}  # one of those of gloss.py


def problem(name: str, scene: Any, given: Options) -> Problem:
    """S of a scene with its true first bounce, and a picture of it."""
    (S,) = scene.transport(first_bounce=scene.first_bounce, device=given.device).systems
    n = S.shape[0]
    R = S.to_dense() - np.eye(n, dtype=np.float32)
    l_d = np.random.default_rng(1).random(n, dtype=np.float32) * (np.arange(n) < n / 3)
    return Problem(name, R, S, l_d + R @ l_d)


def main() -> None:
    given = parse_options(__doc__ or "")
    n, directions = (4, 16) if given.smoke else (16, 64)
    rooms = {f"rho {rho:g}": box(n, sides=6, albedo=rho / (1.0 + rho)) for rho in RADII}
    rooms |= {"corner": box(n, sides=3, albedo=OPEN)}
    rooms |= {"glossy": glossy(dihedral(1), n, 0.5, GLOSS, directions=directions, **ROOM)}
    problems = [problem(name, room, given) for name, room in rooms.items()]
    found: dict[str, dict[str, Any]] = {}
    for method in (name for name in METHODS if name not in (*SAMPLED, "auto")):
        found[method] = {}
        for p in problems:
            s = ltcl.solve(p.S, p.b, method, rtol=RTOL, throw=False)
            if s.converged:
                p.check(method, s.x)
            found[method][p.name] = s.products if s.converged else s.status.name.lower()
    table = Table("method", *rooms)
    for method, products in found.items():
        table.add_row(method, *map(str, products.values()))
    pixels = {f"pixels, {p.name}": len(p.b) for p in problems}
    publish(given, "Products to 1 %", pixels, table, {"products": found}, lambda: None)


if __name__ == "__main__":
    main()
