# SPDX-License-Identifier: BSD-3-Clause
"""The CSR product, beside what memory gives, SciPy, and MKL and cuSPARSE where they are installed.

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

from _harness import Options, Row, parse_options, product, report, seconds, triad
from _peers import sparse_products
from ltcl.operators import CSR

SIDES = (1, 3, 4, 8)
SCIPY_TARGET = {1: 2.0, 8: 3.5}  # times faster
CUSPARSE_TARGET = 0.95  # of its speed, on a GPU
PEERS = {"scipy": "scipy.sparse", "sparse_dot_mkl": "MKL", "cupy": "cuSPARSE (CuPy)"}
SIDE_TARGET = {4: 1 / 0.4, 8: 1 / 0.25}  # times less a side than one side alone
TRIAD_TARGET = 0.9  # part of the triad's bytes a second, where a row is made of runs


def matrix(n: int, per_row: int, run: int, seed: int = 0) -> Any:
    """(n, n) with `per_row` nonzeros in runs of `run` neighbouring columns at distinct random places."""
    rng = np.random.default_rng(seed)
    parts = per_row // run
    # One draw from each of these equal parts: sorted and distinct without rejection.
    edges = np.linspace(0, n // run, parts + 1).astype(int)
    starts = rng.integers(edges[:-1], edges[1:], size=(n, parts)) * run
    columns = (starts[:, :, None] + np.arange(run)).reshape(-1).astype(np.int32)
    values = rng.random(n * per_row, dtype=np.float32) / per_row
    pointers = np.arange(0, n * per_row + 1, per_row, dtype=np.int32)
    return scipy.sparse.csr_array((values, columns, pointers), shape=(n, n))


def compare(given: Options, name: str, A: Any) -> list[Row]:
    """Rows for one matrix; everything is timed in turn, so that all ratios are of one moment."""
    run, nbytes = triad(given.device, given.smoke)
    operator, rng = CSR(given.device, A), np.random.default_rng(1)
    actions: dict[str, Callable[[], object]] = {"triad": run}
    for k in SIDES:
        x = rng.random((A.shape[1], k) if k > 1 else A.shape[1], dtype=np.float32)
        if not np.allclose(operator.dot(x), A @ x, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the product of {name} with {k} right-hand sides is wrong")
        actions[f"ours {k}"] = product(operator, x)
        actions |= {f"{peer} {k}": theirs for peer, theirs in sparse_products(A, x).items()}
    ms = {what: 1e3 * spent for what, spent in seconds(actions).items()}
    rows, alone = [], ms["ours 1"]
    for k in SIDES:
        question, ours = f"{name}, k = {k}", ms[f"ours {k}"]
        targets = {"scipy": SCIPY_TARGET.get(k), "cupy": CUSPARSE_TARGET}
        for peer, who in PEERS.items():
            if (theirs := ms.get(f"{peer} {k}")) is not None:
                rows.append(Row.from_times(question, who, theirs, ours, "ms", targets.get(peer)))
        if k == 1:
            roof, rate = nbytes / ms["triad"] / 1e6, 8 * A.nnz / ours / 1e6
            target = TRIAD_TARGET if "runs" in name else None
            rows.append(Row(question, "our triad", roof, rate, "GB/s", rate / roof, target))
        elif k in SIDE_TARGET:
            rows.append(
                Row.from_times(question, "k = 1", alone, ours / k, "ms a side", SIDE_TARGET[k])
            )
    return rows


def main() -> None:
    given = parse_options(__doc__ or "")
    n, per_row = (2048, 32) if given.smoke else (131072, 256)
    rows = []
    for name, run in (("runs of 16", 16), ("random", 1)):
        rows += compare(given, name, matrix(n, per_row, run))
    report(given, "CSR product", rows, {"pixels": n, "nonzeros a row": per_row})


if __name__ == "__main__":
    main()
