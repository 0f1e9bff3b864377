# SPDX-License-Identifier: BSD-3-Clause
"""A solve to 1 %: products and time, beside the Neumann series and GMRES of NumPy and SciPy.

A closed box of 4056 pixels (dense) and a sparse R of 131072 pixels, 256 nonzeros a row in runs of
16, both of rho(R) = 0.8, where the paper's series still converges; a box with rho(R) = 4, where it
does not; and 3 and 8 right-hand sides at once. Ours is `ltcl.solve` as it is called, `auto`,
transfers included; operators lie on the device and were surveyed before. Competitors get float32.
Every solution is checked in float64.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import gmres

import ltcl
from _coefficients import relative_error
from _harness import Options, Row, parse_options, report, seconds
from csr import matrix
from ltcl.operators import CSR, IdentityPlus

RTOL = 1e-2
PRODUCTS_TARGET = 4.0  # times fewer than Neumann
NEUMANN_TARGET, GMRES_TARGET = 10.0, 5.0  # times faster
DIVERGENT_TARGET = 8  # products at rho(R) = 4
REPEATS = 3


@dataclass(frozen=True)
class Problem:
    """S x = b for `b` (N,) or (N, k), with R (float32) on the host and S = I + R on the device."""

    name: str
    R: Any
    S: IdentityPlus
    b: np.ndarray

    def check(self, who: str, x: np.ndarray) -> None:
        """Stop where a solution is not within the tolerance, in float64."""
        x = np.asarray(x, np.float64)
        residual = relative_error(x + self.R.astype(np.float64) @ x, self.b.astype(np.float64))
        if residual > RTOL * (1 + 1e-3):
            raise SystemExit(f"{who} misses the tolerance of {self.name}: {residual:.3g}")


def box(given: Options, rho: float) -> Problem:
    """A closed box of one albedo m, rho(R) = m / (1 - m), with its true first bounce."""
    scene = ltcl.scenes.box(10 if given.smoke else 26, sides=6, albedo=rho / (1 + rho))
    T = scene.transport(first_bounce=scene.first_bounce, device=given.device)
    R = (T.matrices[0] / T.first_bounce - np.eye(T.shape[0])).astype(np.float32)
    return problem(f"box of {len(R)}, rho {rho:g}", R, T.systems[0])


def problem(name: str, R: Any, S: IdentityPlus, columns: int | None = None) -> Problem:
    """The picture S l_d of random light l_d; `columns` of them."""
    n = R.shape[0]
    l_d = np.random.default_rng(1).random(n if columns is None else (n, columns), dtype=np.float32)
    return Problem(name if columns is None else f"{name}, k = {columns}", R, S, l_d + R @ l_d)


def neumann(problem: Problem) -> tuple[np.ndarray, int]:
    """I - R + R^2 - ... until the next term, which is the residual, is small in every column."""
    x, term, products = np.zeros_like(problem.b), problem.b, 0
    target = RTOL * np.linalg.norm(problem.b, axis=0)
    while np.any(np.linalg.norm(term, axis=0) > target):
        x += term
        term = problem.R @ term
        np.negative(term, out=term)
        products += 1
    return x, products


def scipy_gmres(problem: Problem, full: Any) -> tuple[np.ndarray, int]:
    """One right-hand side after the other; the products are those inside its iteration."""
    calls: list[float] = []
    sides = problem.b.reshape(len(problem.b), -1).T
    rules: dict[str, Any] = {"rtol": RTOL, "restart": 20, "callback": calls.append}
    columns = [gmres(full, side, callback_type="pr_norm", **rules)[0] for side in sides]
    return np.stack(columns, axis=-1).reshape(problem.b.shape), len(calls)


def compare(problem: Problem, facts: dict[str, Any]) -> list[Row]:
    R, identity = problem.R, scipy.sparse.eye_array(problem.R.shape[0]).astype(np.float32)
    full = (
        scipy.sparse.csr_array(identity + R) if scipy.sparse.issparse(R) else R + identity.toarray()
    )
    first = 1e3 * ltcl.solve(problem.S, problem.b, rtol=RTOL).seconds  # builds kernels, tunes
    ours = [ltcl.solve(problem.S, problem.b, rtol=RTOL) for _ in range(2)][1]  # surveys S
    series, products = neumann(problem)
    krylov, steps = scipy_gmres(problem, full)
    for who, x in (("ours", ours.x), ("neumann", series), ("gmres", krylov)):
        problem.check(who, x)
    facts[f"{problem.name}: chosen"] = f"{ours.method}, {ours.products} products: {ours.reason}"
    facts[f"{problem.name}: products of SciPy's GMRES"] = steps
    actions: dict[str, Callable[[], object]] = {
        "ours": lambda: ltcl.solve(problem.S, problem.b, rtol=RTOL),
        "neumann": lambda: neumann(problem),
        "gmres": lambda: scipy_gmres(problem, full),
    }
    times = {name: 1e3 * spent for name, spent in seconds(actions, repeats=REPEATS).items()}
    loop, name = (
        f"{'scipy.sparse' if scipy.sparse.issparse(R) else 'numpy'} Neumann loop",
        problem.name,
    )
    of_neumann, of_gmres = (NEUMANN_TARGET, GMRES_TARGET) if problem.b.ndim == 1 else (None, None)
    new = [Row.from_times(name, "3 later solves", 3 * times["ours"], first, "ms", 1.0)] * (
        problem.b.ndim == 1
    )
    return [
        *new,
        Row.from_times(
            name, "Neumann's products", products, ours.products, "products", PRODUCTS_TARGET
        ),
        Row.from_times(name, loop, times["neumann"], times["ours"], "ms", of_neumann),
        Row.from_times(name, "scipy GMRES", times["gmres"], times["ours"], "ms", of_gmres),
    ]


def main() -> None:
    given, facts = parse_options(__doc__ or ""), {}
    R = matrix(2048, 32, 16) if given.smoke else matrix(131072, 256, 16)
    R.data *= np.repeat(0.8 / R.sum(axis=1), np.diff(R.indptr)).astype(
        np.float32
    )  # row sums are rho(R)
    dense, S = box(given, 0.8), IdentityPlus(CSR(given.device, R))
    large = problem(f"sparse {R.shape[0]}, rho 0.8", R, S)
    rows = compare(dense, facts) + compare(large, facts)
    for k in (3, 8):
        rows += compare(problem(large.name, R, S, k), facts)
    beyond = box(given, 4.0)  # where the paper's series diverges
    paper = ltcl.solve(beyond.S, beyond.b, "neumann", rtol=RTOL, throw=False)
    facts[f"{beyond.name}: Neumann"] = paper.status.name.lower()
    ours = [ltcl.solve(beyond.S, beyond.b, rtol=RTOL) for _ in range(3)][2]  # the second surveys S
    beyond.check("ours", ours.x)
    due = DIVERGENT_TARGET
    rows.append(
        Row.from_times(beyond.name, "products allowed", due, ours.products, "products", 1.0)
    )
    report(given, "Solve to 1 %", rows, facts)


if __name__ == "__main__":
    main()
