# SPDX-License-Identifier: BSD-3-Clause
"""A Gauss-Seidel sweep, beside one product with the same matrix and beside PyAMG's; and block Gauss-Seidel.

S = I + R with N = 131072 pixels and 256 nonzeros a row, in runs of 16 neighbours and at random, and a dense
R of 4096 pixels. Ours is timed with vectors on the device, as inside a solve; PyAMG relaxes S in CSR, in
float32 like ours. Block Gauss-Seidel is another method: it is timed a sweep, and on the way to a solution,
both with all set-up done.
"""

from __future__ import annotations

import functools
import importlib
from typing import Any

import numpy as np
import scipy.sparse

import ltcl
from _harness import Options, Row, options, report, seconds
from csr import matrix
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.relaxation import Sweeps, relaxation
from ltcl.solvers import Solution
from ltcl.solvers.relaxation import BlockGaussSeidel

PRODUCT_TARGET = 1 / 1.1  # a sweep takes at most 1.1 times one product
PYAMG_TARGETS = {"runs of 16": 2.4, "random": 1.4}  # times faster; PyAMG's own limit is the product
PYAMG_DENSE = 6.0


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
    on_device, host = given.device.upload(b), np.zeros(n, np.float32)
    out, relax = on_device.like(), relaxation(S, "gauss_seidel")
    block = relaxation(S, BlockGaussSeidel.name, BlockGaussSeidel().block, None)
    sweeps, blocks = (Sweeps(how, given.device.upload(host), on_device, out.like()) for how in (relax, block))
    full = scipy.sparse.csr_array(scipy.sparse.eye_array(n) + scipy.sparse.csr_array(R)).astype(np.float32)

    def product() -> None:
        S.R.apply(on_device, out)
        given.device.finish()

    def sweep(ours: Sweeps = sweeps) -> None:
        ours.sweep()
        given.device.finish()

    def solve(method: str) -> Solution:
        return ltcl.solve(S, b, method, rtol=1e-4)

    actions: dict[str, Any] = {"product": product, "sweep": sweep, "block": lambda: sweep(blocks)}
    methods = ("gauss_seidel", BlockGaussSeidel.name)
    actions |= {method: functools.partial(solve, method) for method in methods}
    if theirs is not None:
        theirs(full, host, b)
        sweep()
        if not np.allclose(sweeps.x.get(), host, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the sweep of {name} is not that of PyAMG")
        actions["pyamg"] = lambda: theirs(full, host, b)
    times = {key: value * 1e3 for key, value in seconds(actions, repeats=15).items()}
    ours, question = times["sweep"], f"{name}, strips of {relax.block}"
    rows = [
        Row(question, "one product", times["product"], ours, "ms", times["product"] / ours, PRODUCT_TARGET)
    ]
    for theirs_too, key in (("one product", "block"), ("gauss_seidel to 1e-4", BlockGaussSeidel.name)):
        before, after = times[theirs_too.removeprefix("one ").split()[0]], times[key]
        rows.append(Row(f"{name}, block method", theirs_too, before, after, "ms", before / after))
    if theirs is not None:
        target = PYAMG_TARGETS.get(name, PYAMG_DENSE)
        rows.append(Row(question, "pyamg", times["pyamg"], ours, "ms", times["pyamg"] / ours, target))
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
