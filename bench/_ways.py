# SPDX-License-Identifier: BSD-3-Clause
"""Four ways to the direct light of a picture, for `fig7.py`: each ready to run.

Dense R is (I - A)^-1 - I by factorization (`_corner.py`). Both compressed forms come from C of
R = W^T C W, which eq. 21 makes on coefficients from rows of A that stream by, as in `resolution131k.py`; rows
in wavelets are R W^T = W^T C. So neither of these needs a dense R, and both go to any N.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

import ltcl
from _coefficients import analysis, bisect, note, relative
from _corner import Bounce, interreflection
from _harness import Options
from ltcl.compression import invert_coefficients
from ltcl.compression.coefficients import coefficients, drop_below
from ltcl.compression.sources import source
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Tiles, Wavelet, restrict_to_support
from ltcl.scenes import landscape
from ltcl.solvers import matrix_series

ALBEDO, ERROR = 0.8, 1e-2
DROPPED = 0.7e-2  # of the error, what compression may take; the iteration has the rest
TOLERANCES = 0.5 ** np.arange(1, 12, 0.5)
THRESHOLD, FINE = 1e-4, 5e-4  # of numbers of A; of R before it is thresholded
MOST = 128  # wavelets a row from which the largest are chosen
MEMORY = 1 << 28  # bytes of a block


@dataclass(frozen=True)
class Problem:
    """A corner, a picture of it, (N,) float32, and the direct light that makes it, (N,) float64."""

    rows: Bounce
    l_out: np.ndarray
    l_d: np.ndarray


@dataclass(frozen=True)
class Way:
    """A method that is ready to run, and figures of its first run."""

    run: Callable[[], np.ndarray]
    error: float
    first: float
    products: int
    nbytes: int
    kept: float


def problem(n: int) -> Problem:
    """The corner under a landscape."""
    rows = Bounce(n, ALBEDO)
    l_out = 0.05 + 0.4 * landscape(*rows.grid).mean(axis=2).reshape(-1)
    return Problem(rows, l_out, l_out - rows.matmat(l_out))


def iterated(S: IdentityPlus, at: Problem, rtol: float) -> ltcl.Solution:
    """Eq. 20."""
    return ltcl.solve(S, at.l_out, "jacobi", rtol=rtol)


def by_steps(S: IdentityPlus, at: Problem, kept: float) -> Way:
    """The iteration, with the loosest tolerance whose error is small enough."""
    enough = (t for t in TOLERANCES if relative(iterated(S, at, t).x, at.l_d) <= ERROR)
    rtol = float(next(enough, TOLERANCES[-1]))
    s = iterated(S, at, rtol)
    error = relative(s.x, at.l_d)
    return Way(lambda: iterated(S, at, rtol).x, error, s.seconds, s.products, S.nbytes, kept)


def dense(given: Options, at: Problem) -> IdentityPlus:
    """S with every number of R."""
    R = interreflection(at.rows.n, ALBEDO, lambda said: note(f"N = {len(at.l_out)}: {said.strip()}"))
    return IdentityPlus(Dense(given.device, R))


def by_matrices(S: IdentityPlus, at: Problem, iteration: Way) -> Way:
    """The series, of as many terms as the iteration has steps: their sums are the same."""
    steps = iteration.products - 1
    return _series(lambda: matrix_series(S, steps=steps).x, at, iteration)


def by_numpy(S: IdentityPlus, at: Problem, iteration: Way) -> Way:
    """The same by the products of NumPy's BLAS."""
    less = -S.R.to_dense().astype(np.float32)

    def inverse() -> np.ndarray:
        term, total = less, np.eye(len(less), dtype=np.float32) + less
        for _ in range(iteration.products - 2):
            term = term @ less
            total += term
        return total

    return _series(inverse, at, iteration)


def _series(inverse: Callable[[], np.ndarray], at: Problem, like: Way) -> Way:
    def run() -> np.ndarray:
        return inverse() @ at.l_out.astype(np.float32)

    start = time.perf_counter()
    l_d = run()
    spent = time.perf_counter() - start
    return Way(run, relative(l_d, at.l_d), spent, like.products - 1, like.nbytes, like.kept)


def of_both(given: Options, at: Problem) -> Any:
    """C of R = W^T C W in db2, far finer than needed."""
    transform = analysis(Wavelet(given.device, at.rows.grid, "db2"))
    rows = source("A", at.rows, MEMORY)
    A = coefficients(rows, transform, transform, THRESHOLD, first=THRESHOLD / 4)
    return -invert_coefficients(-A.core, rtol=FINE).D


def of_rows(given: Options, at: Problem, C: Any) -> Any:
    """R W^T = W^T C, one column of C after the other."""
    W = Wavelet(given.device, at.rows.grid, "db2")

    def synthesis(a: np.ndarray) -> np.ndarray:
        return W.apply_transpose(given.device.upload(a)).get()

    columns = source("C", scipy.sparse.csr_array(C.T), MEMORY)
    drop, most = FINE * float(np.linalg.norm(C.data)), MOST * C.shape[0]
    found = coefficients(columns, None, synthesis, drop=drop, most=most)
    return scipy.sparse.csr_array(found.core.T)


def by_wavelets(given: Options, at: Problem, C: Any, both: bool) -> Way:
    """The fewest numbers that will do, in 16 bits, and the iteration with these."""
    W = Wavelet(given.device, at.rows.grid, "db2")

    def system(core: Any, V: Any = W) -> IdentityPlus:
        return IdentityPlus(Compressed(core, V if both else None, V))

    def error(threshold: float) -> float:
        S = system(CSR(given.device, drop_below(C, threshold)[0]))
        return relative(iterated(S, at, DROPPED / 10).x, at.l_d)

    threshold = bisect(error, DROPPED, float(np.abs(C.data).max()))
    kept, _ = drop_below(C, threshold)
    core, V = restrict_to_support(kept, W) if both else (kept, W)
    return by_steps(system(Tiles(given.device, core, 1, "float16"), V), at, core.nnz / len(at.l_out))
