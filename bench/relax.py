# SPDX-License-Identifier: BSD-3-Clause
"""A Gauss-Seidel sweep, beside one product with the same matrix and beside PyAMG's sweep.

S = I + R with N = 131072 pixels and 256 nonzeros a row, in runs of 16 neighbours and at random, and a dense
R of 4096 pixels. Ours is timed with vectors on the device, as inside a solve; PyAMG relaxes S in CSR, in
float32 like ours.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import scipy.sparse

from _harness import Options, Row, options, report, seconds
from csr import matrix
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.relaxation import Sweep, relaxation

PRODUCT_TARGET = 1 / 1.15  # a sweep takes at most 1.15 times one product
PYAMG_TARGET = 8.0  # times faster


def pyamg_sweep() -> Any:
    """PyAMG's `gauss_seidel`, or None where it is not installed."""
    try:
        return importlib.import_module("pyamg.relaxation.relaxation").gauss_seidel
    except ImportError:
        print("pyamg is not installed (pip install pyamg, or the extra `bench`): its rows are left out")
        return None


def compare(given: Options, name: str, R: Any, theirs: Any) -> list[Row]:
    """Rows for one matrix."""
    sparse = scipy.sparse.issparse(R)
    S = IdentityPlus(CSR(given.device, R) if sparse else Dense(given.device, R))
    n = S.shape[0]
    b = np.random.default_rng(1).random(n, dtype=np.float32)
    x, on_device = given.device.upload(np.zeros(n)), given.device.upload(b)
    state, relax = Sweep(x, on_device, x.like(), x.like(), x.like()), relaxation(S, "gauss_seidel")
    out, host = x.like(), np.zeros(n, np.float32)
    full = scipy.sparse.csr_array(scipy.sparse.eye_array(n) + scipy.sparse.csr_array(R)).astype(np.float32)

    def product() -> None:
        S.R.apply(on_device, out)
        given.device.finish()

    def sweep() -> None:
        relax.sweep(state, 1.0)
        given.device.finish()

    actions: dict[str, Any] = {"product": product, "sweep": sweep}
    if theirs is not None:
        theirs(full, host, b)
        sweep()
        if not np.allclose(x.get(), host, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the sweep of {name} is not that of PyAMG")
        actions["pyamg"] = lambda: theirs(full, host, b)
    times = {key: value * 1e3 for key, value in seconds(actions, repeats=15).items()}
    ours, question = times["sweep"], f"{name}, blocks of {relax.block}"
    rows = [
        Row(question, "one product", times["product"], ours, "ms", times["product"] / ours, PRODUCT_TARGET)
    ]
    if theirs is not None:
        rows.append(Row(question, "pyamg", times["pyamg"], ours, "ms", times["pyamg"] / ours, PYAMG_TARGET))
    return rows


def main() -> None:
    """Run the bench."""
    given = options(__doc__ or "")
    n, per_row, dense = (2048, 32, 256) if given.smoke else (131072, 256, 4096)
    theirs = pyamg_sweep()
    rows = []
    for name, run in (("runs of 16", 16), ("random", 1)):
        rows += compare(given, name, matrix(n, per_row, run), theirs)
    R = np.random.default_rng(2).random((dense, dense), dtype=np.float32) / dense
    rows += compare(given, f"dense {dense}", R, theirs)
    report(given, "Gauss-Seidel sweep", rows, {"pixels": n, "nonzeros a row": per_row})


if __name__ == "__main__":
    main()
