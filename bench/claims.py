# SPDX-License-Identifier: BSD-3-Clause
"""No answer is quietly wrong: random systems of all kinds, methods and scales, all claims checked.

S is well conditioned, nearly singular, of entries that differ by many orders, a diffuse scene, or
all but the identity, in every form that `solve` takes; S and b are scaled by up to 1e30 and down to
1e-30 (methods that sample need S = I + R, which is not scaled). The residual of each solve that
says CONVERGED is computed in extended precision, with the numbers of the input: above 1.01 times
the tolerance the claim counts as untrue. A solve may well fail, as long as it says so.
"""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
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

# Largest true residual over the tolerance.
CLAIM = 1.01
SOLVES = 100_000
SMOKE_SOLVES = 300
# Solves of a process before it tells what it found.
CHUNK = 500
# A share of the solves has so many pixels that claims rest on bounds.
LARGE = 2100
LARGE_SHARE = 0.001
SMALL_SIZES = [1, 2, 3, 7, 20, 60]
# Exponents of the scales of S and b.
# Smallest exponents of tolerances: most are those of users, some of float32, a few of float64.
LEAST_EXPONENTS = [-4.0, -4.0, -4.0, -4.0, -4.0, -8.0, -8.0, -8.0, -12.0, -12.0]
EXPONENTS = [-30.0, -20.0, -5.0, 0.0, 0.0, 0.0, 5.0, 20.0, 30.0]

Random = np.random.Generator


def well_conditioned(random: Random, n: int) -> np.ndarray:
    """I + R with a small R of both signs."""
    return np.eye(n) + random.normal(size=(n, n)) * random.uniform(0.0, 0.5) / np.sqrt(n)


def nearly_singular(random: Random, n: int) -> np.ndarray:
    """Smallest singular value down to 1e-14 of the largest, between products of reflections."""
    S = np.diag(random.uniform(0.5, 1.5, n))
    S[-1, -1] = 10.0 ** random.uniform(-14.0, -1.0)
    for v in random.normal(size=(6, n)):
        S -= np.outer(2.0 / (v @ v) * v, v @ S)
        S = S.T.copy()
    return S


def uneven(random: Random, n: int) -> np.ndarray:
    """Rows and columns of very different sizes."""
    rows = 10.0 ** random.uniform(-4.0, 4.0, n)
    columns = 10.0 ** random.uniform(-4.0, 4.0, n)
    return well_conditioned(random, n) * rows[:, None] * columns


def diffuse(random: Random, n: int) -> np.ndarray:
    """All bounces of a closed room, rho(R) up to 100."""
    G = random.uniform(0.1, 1.0, (n, n))
    G = (G + G.T) / np.sum(G + G.T, axis=1).max()
    rho = 10.0 ** random.uniform(-1.0, 2.0)
    return np.linalg.inv(np.eye(n) - rho / (1.0 + rho) * G)


def nearly_identity(random: Random, n: int) -> np.ndarray:
    """I + R with few and small entries in R, or none: few bounces."""
    R = random.normal(size=(n, n)) * 10.0 ** random.uniform(-12.0, -0.5) / n
    is_entry = random.random((n, n)) < random.choice([0.0, 0.1, 1.0])
    return np.eye(n) + R * is_entry


MATRICES: dict[str, Callable[[Random, int], np.ndarray]] = {
    "well_conditioned": well_conditioned,
    "nearly_singular": nearly_singular,
    "uneven": uneven,
    "diffuse": diffuse,
    "nearly_identity": nearly_identity,
}


def identity_plus(device: Device, S: np.ndarray) -> tuple[Any, np.ndarray]:
    """I + R, with R as the device stores it."""
    R = (S - np.eye(len(S))).astype(np.float32)
    return IdentityPlus(Dense(device, R)), np.eye(len(S)) + R.astype(np.longdouble)


def tiles(device: Device, S: np.ndarray) -> tuple[Any, np.ndarray]:
    """Tiles of float16, whose numbers are rounded."""
    A = Tiles(device, scipy.sparse.csr_array(S))
    return A, A.matrix().toarray()


# Forms of S for `solve`, with their exact numbers.
FORMS: dict[str, Callable[[Device, np.ndarray], tuple[Any, np.ndarray]]] = {
    "float64 array": lambda device, S: (S, S),
    "float32 array": lambda device, S: (S.astype(np.float32), S.astype(np.float32)),
    "scipy.sparse": lambda device, S: (scipy.sparse.csr_array(S), S),
    "LinearOperator": lambda device, S: (aslinearoperator(S), S),
    "Dense": lambda device, S: (Dense(device, S), S.astype(np.float32)),
    "CSR": lambda device, S: (CSR(device, scipy.sparse.csr_array(S)), S),
    "tiles": tiles,
    "I + R": identity_plus,
}


@dataclass(frozen=True, kw_only=True)
class Case:
    """A random system, and how it is solved."""

    n: int
    matrix: str
    form: str
    method: str
    scale_S: float
    scale_b: float
    rtol: float
    options: dict[str, Any]

    def __str__(self) -> str:
        scales = f"scales {self.scale_S:g} and {self.scale_b:g}"
        return (
            f"{self.matrix}, {self.form}, N = {self.n}, {self.method}, {scales}, "
            f"rtol {self.rtol:.2g}, {self.options}"
        )


def draw_case(random: Random) -> Case:
    """Draw all but the numbers of a system."""
    if random.uniform() < LARGE_SHARE:
        n = LARGE
    else:
        n = int(random.choice(SMALL_SIZES))
    matrix = str(random.choice(list(MATRICES)))
    form = str(random.choice(list(FORMS)))
    method = str(random.choice(METHODS))
    scale_S, scale_b = 10.0 ** random.choice(EXPONENTS, 2)
    options = {}
    if method in SAMPLED:
        scale_S = 1.0
        options = {"gather": bool(random.integers(2)), "seed": int(random.integers(1 << 32))}
        if random.uniform() < 0.8:
            matrix = str(random.choice(["well_conditioned", "nearly_identity"]))
            form = str(random.choice(["float64 array", "Dense", "CSR", "I + R"]))
    rtol = 10.0 ** random.uniform(random.choice(LEAST_EXPONENTS), -0.5)
    return Case(
        n=n,
        matrix=matrix,
        form=form,
        method=method,
        scale_S=scale_S,
        scale_b=scale_b,
        rtol=rtol,
        options=options,
    )


def find_untrue_claim(device: Device, random: Random, tally: Counter[str]) -> str | None:
    """Run one random solve and return its claim, if it is untrue."""
    case = draw_case(random)
    shape = (case.n,)
    if random.uniform() < 0.3:
        shape = (case.n, 3)
    b = random.uniform(-0.3, 1.0, shape) * case.scale_b
    try:
        with np.errstate(all="ignore"):
            scaled = MATRICES[case.matrix](random, case.n) * case.scale_S
            S, numbers = FORMS[case.form](device, scaled)
        solution = ltcl.solve(
            S, b, case.method, rtol=case.rtol, throw=False, maxiter=200, **case.options
        )
    except InputError:
        tally["refused"] += 1
        return None
    tally[solution.status.name] += 1
    if solution.converged and case.method in SAMPLED:
        tally["CONVERGED by methods that sample"] += 1
    if not solution.converged:
        return None
    residual = true_residual(numbers, solution.x, b, case.scale_b)
    if residual <= CLAIM * case.rtol:
        return None
    return f"{case}: claimed {solution.residual:.2g}, is {residual:.2g}"


def true_residual(S: np.ndarray, x: np.ndarray, b: np.ndarray, scale: float) -> float:
    """Relative residual of the worst column, in extended precision; `scale` is that of b."""
    b_extended = b.astype(np.longdouble)
    product = S.astype(np.longdouble) @ x.astype(np.longdouble)
    residual = ((b_extended - product) / scale).astype(np.float64)
    right_side = (b_extended / scale).astype(np.float64)
    ratios = np.linalg.norm(residual, axis=0) / np.linalg.norm(right_side, axis=0)
    return float(np.max(ratios))


def run_chunk(chunk: tuple[str, int, int]) -> tuple[Counter[str], list[str]]:
    """Run so many solves on a device, with random numbers of their own; tally and untrue claims."""
    index, seed, solves = chunk
    device = ltcl.open_device(index)
    random = np.random.default_rng(seed)
    tally = Counter[str]()
    untrue = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(solves):
            claim = find_untrue_claim(device, random, tally)
            if claim is not None:
                untrue.append(claim)
    return tally, untrue


def main() -> None:
    """Run the bench; exit status 1 if a claim is untrue."""
    options = parse_options(__doc__)
    total = SOLVES
    processes = os.cpu_count()
    if options.smoke:
        total = SMOKE_SOLVES
        processes = 1
    index = options.device.description.index
    solves = min(total, CHUNK)
    chunks = [(index, seed, solves) for seed in range(total // solves)]
    tally = Counter[str]()
    untrue = []
    with get_context("spawn").Pool(processes) as pool:
        for chunk_tally, chunk_untrue in pool.imap_unordered(run_chunk, chunks):
            tally += chunk_tally
            untrue += chunk_untrue
    row = Row(
        question="untrue claims",
        competitor=f"of {total} solves",
        theirs=0.0,
        ours=len(untrue),
        unit="claims",
        ratio=float(not untrue),
        target=1.0,
    )
    facts: dict[str, Any] = dict(sorted(tally.items()))
    for number, claim in enumerate(untrue):
        facts[f"untrue {number}"] = claim
    report(options, "Claims of convergence", [row], facts)
    if untrue:
        raise SystemExit(f"{len(untrue)} of {total} solves claim what is not so")


if __name__ == "__main__":
    main()
