# SPDX-License-Identifier: BSD-3-Clause
"""A solver of your own: Polyak's heavy ball, a method for `ltcl.solve`.

With the spectrum of S in [a, b], 0 < a, each step is d = keep d + gain r, x = x + d, where

    gain = 4 / (sqrt(b) + sqrt(a))^2,    keep = ((sqrt(b) - sqrt(a)) / (sqrt(b) + sqrt(a)))^2

(B. Polyak, Some methods of speeding up the convergence of iteration methods, 1964). In ltcl itself
the class would stand in a file of `ltcl/solvers`, with its name in that file's METHODS.
"""

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

import ltcl
from ltcl import theory
from ltcl.device import Array
from ltcl.solvers.method import IterativeMethod
from ltcl.solvers.stationary import take_steps
from ltcl.solvers.stopping import CountedOperator, Monitor


@dataclass(frozen=True)
class HeavyBall(IterativeMethod):
    """The heavy ball, with the bounds on the spectrum that S tells for free."""

    name: ClassVar[str] = "heavy_ball"

    def iterate(self, system: CountedOperator, x: Array, r: Array, monitor: Monitor) -> None:
        """Improve `x`, whose residual is `r`, until the monitor ends the solve."""
        lower, upper = theory.free_bounds(system.S)
        roots = math.sqrt(upper) + math.sqrt(lower)
        gain = 4.0 / roots**2
        keep = ((math.sqrt(upper) - math.sqrt(lower)) / roots) ** 2
        # The first step has no direction to keep.
        coefficients = itertools.chain([(0.0, gain)], itertools.repeat((keep, gain)))
        # It takes steps, keeps r = b - S x, counts products and asks the one stopping rule.
        for _ in take_steps(system, x, r, monitor, coefficients):
            pass


def main() -> None:
    """Undo the bounces of a corner, and count the products beside those of Richardson."""
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    picture = np.full(T.grid, 0.5, np.float32).ravel()
    ours = ltcl.solve(T.interreflection, picture, HeavyBall(), rtol=1e-5)
    theirs = ltcl.solve(T.interreflection, picture, "richardson", rtol=1e-5)
    difference = np.linalg.norm(ours.x - theirs.x) / np.linalg.norm(theirs.x)
    assert ours.converged
    assert difference < 1e-4
    print(f"heavy ball: {ours.products} products; Richardson: {theirs.products}")


if __name__ == "__main__":
    main()
