# SPDX-License-Identifier: BSD-3-Clause
"""How close is the CSR product to what memory gives, and how far ahead of SciPy?

N = 131072 pixels, 256 nonzeros a row, in runs of 16 neighbours (as light transport has them) and at random;
1, 3, 4 and 8 right-hand sides. Ours is timed with vectors on the device, as inside a solve.
Bytes are 8 per nonzero (float32 value, 32-bit column), counted once however many right-hand sides there are.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse
from _harness import Options, Row, Triad, options, report, seconds

from ltcl.operators import CSR

SIDES = (1, 3, 4, 8)
PER_SIDE_TARGET = {4: 0.4, 8: 0.25}  # time a side, as a part of that of one side alone


def matrix(n: int, per_row: int, run: int, seed: int = 0) -> scipy.sparse.csr_array:
    """(n, n) with `per_row` nonzeros in runs of `run` neighbouring columns at distinct random places."""
    rng = np.random.default_rng(seed)
    stretches = n // run
    # One draw from each of per_row / run equal parts: sorted and distinct without rejection.
    parts = per_row // run
    edges = np.linspace(0, stretches, parts + 1).astype(int)
    starts = rng.integers(edges[:-1], edges[1:], size=(n, parts)) * run
    columns = (starts[:, :, None] + np.arange(run)).reshape(-1).astype(np.int32)
    values = rng.random(n * per_row, dtype=np.float32) / per_row
    pointers = np.arange(0, n * per_row + 1, per_row, dtype=np.int32)
    return scipy.sparse.csr_array((values, columns, pointers), shape=(n, n))


def compare(given: Options, name: str, A: scipy.sparse.csr_array, triad: Triad) -> list[Row]:
    """Rows for one matrix."""
    operator, rows, alone = CSR(given.device, A), [], 0.0
    rng = np.random.default_rng(1)
    for k in SIDES:
        x = rng.random((A.shape[1], k) if k > 1 else A.shape[1], dtype=np.float32)
        on_device = given.device.upload(x)
        out = operator.apply(on_device)
        if not np.allclose(out.get(), A @ x, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the product of {name} with {k} right-hand sides is wrong")

        def ours(x=on_device, out=out) -> None:
            operator.apply(x, out)
            given.device.finish()

        times = seconds({"triad": triad, "ours": ours, "scipy": lambda x=x: A @ x})
        question = f"{name}, k = {k}"
        rows.append(
            Row(question, "scipy.sparse, ms", times["scipy"] * 1e3, times["ours"] * 1e3, "ms",
                times["scipy"] / times["ours"], {1: 2.0, 8: 3.0}.get(k))
        )  # fmt: skip
        if k == 1:
            alone = times["ours"]
            roof, rate = triad.nbytes / times["triad"] / 1e9, 8 * A.nnz / alone / 1e9
            rows.append(Row(question, "our triad, GB/s", roof, rate, "GB/s", rate / roof, 0.9 if "runs" in name else None))
        elif k in PER_SIDE_TARGET:
            side = times["ours"] / k
            gain = alone / side
            rows.append(Row(question, "k = 1, ms a side", alone * 1e3, side * 1e3, "ms", gain, 1 / PER_SIDE_TARGET[k]))
    return rows


def main() -> None:
    """Run the bench."""
    given = options(__doc__ or "")
    n, per_row = (2048, 32) if given.smoke else (131072, 256)
    triad = Triad(given.device, given.smoke)
    rows = []
    for name, run in (("runs of 16", 16), ("random", 1)):
        rows += compare(given, name, matrix(n, per_row, run), triad)
    report(given, "CSR product", rows, {"pixels": n, "nonzeros a row": per_row})


if __name__ == "__main__":
    main()
