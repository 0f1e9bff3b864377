# SPDX-License-Identifier: BSD-3-Clause
"""No answer that is quietly wrong: random systems of all kinds, methods and scales, every claim checked.

S is well conditioned, nearly singular, of entries that differ by many orders, or a diffuse scene,
in every form that `solve` takes; S and b are scaled by up to 1e30 and down to 1e-30. Of each solve
that says CONVERGED the residual is computed in extended precision, with the numbers that were
given: above 1.01 times the tolerance it counts as untrue. A solve may well fail, as long as it says
so.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from _harness import Row, parse_options, report
from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus, Tiles
from ltcl.solvers.solve import METHODS, SAMPLED

CLAIM = 1.01  # times the tolerance
SOLVES = {True: 300, False: 10_000}
LARGE, SHARE = 2100, 0.005  # pixels, of a share of the solves: where claims rest on bounds

Random = np.random.Generator


def well_conditioned(random: Random, n: int) -> np.ndarray:
    """I + R with a small R of both signs."""
    return np.eye(n) + random.normal(size=(n, n)) * random.uniform(0.0, 0.5) / np.sqrt(n)


def nearly_singular(random: Random, n: int) -> np.ndarray:
    """Least singular value down to 1e-14 of the largest, between products of reflections."""
    S = np.diag(random.uniform(0.5, 1.5, n))
    S[-1, -1] = 10.0 ** random.uniform(-14.0, -1.0)
    for v in random.normal(size=(6, n)):
        S -= np.outer(2.0 / (v @ v) * v, v @ S)
        S = S.T.copy()
    return S


def uneven(random: Random, n: int) -> np.ndarray:
    """Rows and columns of very different sizes."""
    rows, columns = (10.0 ** random.uniform(-4.0, 4.0, n) for _ in range(2))
    return well_conditioned(random, n) * rows[:, None] * columns


def diffuse(random: Random, n: int) -> np.ndarray:
    """All bounces of a closed room, rho(R) up to 100."""
    G = random.uniform(0.1, 1.0, (n, n))
    G = (G + G.T) / np.sum(G + G.T, axis=1).max()
    rho = 10.0 ** random.uniform(-1.0, 2.0)
    return np.linalg.inv(np.eye(n) - rho / (1.0 + rho) * G)


MATRICES = {make.__name__: make for make in (well_conditioned, nearly_singular, uneven, diffuse)}


def identity_plus(device: Device, S: np.ndarray) -> tuple[Any, np.ndarray]:
    """I + R, with R as it lies on the device."""
    R = (S - np.eye(len(S))).astype(np.float32)
    return IdentityPlus(Dense(device, R)), np.eye(len(S)) + R.astype(np.longdouble)


# S as it is given to solve, and its numbers: tiles of float16 stand for other ones.
KINDS: dict[str, Callable[[Device, np.ndarray], tuple[Any, np.ndarray]]] = {
    "float64 array": lambda device, S: (S, S),
    "float32 array": lambda device, S: (S.astype(np.float32), S.astype(np.float32)),
    "scipy.sparse": lambda device, S: (scipy.sparse.csr_array(S), S),
    "LinearOperator": lambda device, S: (aslinearoperator(S), S),
    "Dense": lambda device, S: (Dense(device, S), S.astype(np.float32)),
    "CSR": lambda device, S: (CSR(device, scipy.sparse.csr_array(S)), S),
    "tiles": lambda device, S: (
        A := Tiles(device, scipy.sparse.csr_array(S)),
        A.matrix().toarray(),
    ),
    "I + R": identity_plus,
}


def untrue(device: Device, random: Random, tally: Counter[str]) -> str | None:
    """One random solve; what was claimed and is not so, if anything."""
    n = LARGE if random.uniform() < SHARE else int(random.choice([1, 2, 3, 7, 20, 60]))
    methods = [method for method in METHODS if method not in SAMPLED]
    matrix, kind, method = (str(random.choice(list(of))) for of in (MATRICES, KINDS, methods))
    scale_S, scale_b = 10.0 ** random.choice(
        [-30.0, -20.0, -5.0, 0.0, 0.0, 0.0, 5.0, 20.0, 30.0], 2
    )
    rtol = 10.0 ** random.uniform(-8.0 if random.uniform() < 0.3 else -4.0, -0.5)
    b = random.uniform(-0.3, 1.0, (n, 3) if random.uniform() < 0.3 else n) * scale_b
    try:
        with np.errstate(all="ignore"):
            S, numbers = KINDS[kind](device, MATRICES[matrix](random, n) * scale_S)
        s = ltcl.solve(S, b, method, rtol=rtol, throw=False, maxiter=200)
    except InputError:
        tally["refused"] += 1
        return None
    tally[s.status.name] += 1
    if not s.converged:
        return None
    x, b = s.x.astype(np.longdouble), b.astype(np.longdouble)
    residual = (b - numbers.astype(np.longdouble) @ x) / scale_b
    left = np.linalg.norm(residual.astype(np.float64), axis=0)
    truth = float(np.max(left / np.linalg.norm((b / scale_b).astype(np.float64), axis=0)))
    if truth <= CLAIM * rtol:
        return None
    what = (
        f"{matrix}, {kind}, N = {n}, {method}, scales {scale_S:g} and {scale_b:g}, rtol {rtol:.2g}"
    )
    return f"{what}: claimed {s.residual:.2g}, is {truth:.2g}"


def main() -> None:
    given = parse_options(__doc__ or "")
    random, tally, total = np.random.default_rng(0), Counter[str](), SOLVES[given.smoke]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        claims = [untrue(given.device, random, tally) for _ in range(total)]
    found = [claim for claim in claims if claim is not None]
    rows = [
        Row("untrue claims", f"of {total} solves", 0.0, len(found), "claims", float(not found), 1.0)
    ]
    facts = dict(tally) | {f"untrue {i}": claim for i, claim in enumerate(found)}
    report(given, "Claims of convergence", rows, facts)
    if found:
        raise SystemExit(f"{len(found)} of {total} solves claim what is not so")


if __name__ == "__main__":
    main()
