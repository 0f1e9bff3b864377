# SPDX-License-Identifier: BSD-3-Clause
"""The CSR product, beside memory bandwidth, SciPy, and MKL and cuSPARSE if they are installed.

N = 131072 pixels, 256 nonzeros a row, in runs of 16 neighbours (as light transport has them) and at
random; 1, 3, 4 and 8 right-hand sides. Ours is timed with vectors on the device, as inside a solve.
Bytes are 8 per nonzero (float32 value, 32-bit column), counted once however many right-hand sides
there are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from _harness import Options, Row, milliseconds, parse_options, product, report, triad
from _peers import sparse_products
from ltcl.operators import CSR

# Numbers of right-hand sides.
SIDES = (1, 3, 4, 8)
PEERS = {"scipy": "scipy.sparse", "sparse_dot_mkl": "MKL", "cupy": "cuSPARSE (CuPy)"}
# Least ratio to SciPy by right-hand sides, and to cuSPARSE, on a GPU.
SCIPY_TARGET = {1: 2.0, 8: 3.5}
CUSPARSE_TARGET = 0.95
# Least ratio to MKL with one right-hand side.
MKL_TARGET = 1.0
# Ratio of the time of one side alone to the time a side.
SIDE_TARGET = {4: 1 / 0.4, 8: 1 / 0.25}
# Share of the triad's bytes a second, if a row is made of runs.
TRIAD_TARGET = 0.9


def matrix(n: int, per_row: int, run: int, seed: int = 0) -> Any:
    """Make an (n, n) matrix with `per_row` nonzeros a row.

    They are in runs of `run` neighbouring columns, which begin at distinct random places.
    """
    rng = np.random.default_rng(seed)
    parts = per_row // run
    # One draw from each of these equal parts: sorted and distinct without rejection.
    edges = np.linspace(0, n // run, parts + 1).astype(int)
    starts = rng.integers(edges[:-1], edges[1:], size=(n, parts)) * run
    columns = (starts[:, :, None] + np.arange(run)).reshape(-1).astype(np.int32)
    values = rng.random(n * per_row, dtype=np.float32) / per_row
    pointers = np.arange(0, n * per_row + 1, per_row, dtype=np.int32)
    return scipy.sparse.csr_array((values, columns, pointers), shape=(n, n))


def compare(options: Options, name: str, A: Any) -> list[Row]:
    """Compare on one matrix; everything is timed in turn, so that all ratios are of one moment."""
    run_triad, triad_bytes = triad(options.device, options.smoke)
    actions = {"triad": run_triad} | product_actions(options, name, A)
    ms = milliseconds(actions)
    rows = []
    for k in SIDES:
        rows += peer_rows(f"{name}, k = {k}", k, ms)
        if k == 1:
            bandwidth = triad_bytes / ms["triad"] / 1e6
            rate = 8 * A.nnz / ms["ours 1"] / 1e6
            rows.append(bandwidth_row(name, bandwidth, rate))
        elif k in SIDE_TARGET:
            rows.append(side_row(name, k, ms))
    return rows


def product_actions(options: Options, name: str, A: Any) -> dict[str, Callable[[], object]]:
    """Products by us and by all peers, for each number of right-hand sides."""
    operator = CSR(options.device, A)
    rng = np.random.default_rng(1)
    actions: dict[str, Callable[[], object]] = {}
    for k in SIDES:
        shape = (A.shape[1], k)
        if k == 1:
            shape = (A.shape[1],)
        x = rng.random(shape, dtype=np.float32)
        if not np.allclose(operator.dot(x), A @ x, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the product of {name} with {k} right-hand sides is wrong")
        actions[f"ours {k}"] = product(operator, x)
        for peer, run in sparse_products(A, x).items():
            actions[f"{peer} {k}"] = run
    return actions


def peer_rows(question: str, k: int, ms: dict[str, float]) -> list[Row]:
    """Compare with all peers that are installed."""
    targets = {"scipy": SCIPY_TARGET.get(k), "cupy": CUSPARSE_TARGET}
    if k == 1:
        targets["sparse_dot_mkl"] = MKL_TARGET
    ours = ms[f"ours {k}"]
    rows = []
    for peer, competitor in PEERS.items():
        theirs = ms.get(f"{peer} {k}")
        if theirs is not None:
            target = targets.get(peer)
            rows.append(Row.from_times(question, competitor, theirs, ours, "ms", target))
    return rows


def bandwidth_row(name: str, bandwidth: float, rate: float) -> Row:
    """Compare the product's bytes a second with those of the triad."""
    return Row(
        question=f"{name}, k = 1",
        competitor="our triad",
        theirs=bandwidth,
        ours=rate,
        unit="GB/s",
        ratio=rate / bandwidth,
        target=TRIAD_TARGET if "runs" in name else None,
    )


def side_row(name: str, k: int, ms: dict[str, float]) -> Row:
    """Compare the time a side with that of one side alone."""
    alone = ms["ours 1"]
    share = ms[f"ours {k}"] / k
    question = f"{name}, k = {k}"
    return Row.from_times(question, "k = 1", alone, share, "ms a side", SIDE_TARGET[k])


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    n = 131072
    per_row = 256
    if options.smoke:
        n = 2048
        per_row = 32
    rows = []
    for name, run in (("runs of 16", 16), ("random", 1)):
        rows += compare(options, name, matrix(n, per_row, run))
    report(options, "CSR product", rows, {"pixels": n, "nonzeros a row": per_row})


if __name__ == "__main__":
    main()
