# SPDX-License-Identifier: BSD-3-Clause
"""A Gauss-Seidel sweep, beside one product with the same matrix and beside PyAMG's; and block Gauss-Seidel.

S = I + R with N = 131072 pixels and 256 nonzeros a row, in runs of 16 neighbours and at random, and
a dense R of 4096 pixels. Ours is timed with vectors on the device, as inside a solve; PyAMG relaxes
S in CSR, in float32 like ours. Block Gauss-Seidel is another method, of which a sweep is timed.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

import numpy as np
import scipy.sparse

from _harness import Options, Row, parse_options, product, report, seconds
from csr import matrix
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.relaxation import Sweeps, relaxation
from ltcl.solvers.relaxation import BlockGaussSeidel

PRODUCT_TARGET = 1 / 1.1  # a sweep takes at most 1.1 times one product
PYAMG_TARGETS = {"runs of 16": 2.4, "random": 1.4}  # times faster; PyAMG's own limit is the product
PYAMG_DENSE = 6.0


def compare(given: Options, name: str, R: Any, theirs: Any) -> list[Row]:
    sparse = scipy.sparse.issparse(R)
    S = IdentityPlus(CSR(given.device, R) if sparse else Dense(given.device, R))
    n = S.shape[0]
    b = np.random.default_rng(1).random(n, dtype=np.float32)
    on_device, host = given.device.upload(b), np.zeros(n, np.float32)
    relax = relaxation(S, "gauss_seidel")
    block = relaxation(S, BlockGaussSeidel.name, BlockGaussSeidel().block, None)
    upload = given.device.upload
    sweeps, blocks = (
        Sweeps(how, upload(host), on_device, on_device.like()) for how in (relax, block)
    )
    full = scipy.sparse.csr_array(scipy.sparse.eye_array(n) + scipy.sparse.csr_array(R)).astype(
        np.float32
    )

    def sweep(ours: Sweeps = sweeps) -> None:
        ours.sweep()
        given.device.finish()

    actions: dict[str, Any] = {
        "product": product(S.R, b),
        "sweep": sweep,
        "block": lambda: sweep(blocks),
    }
    if theirs is not None:
        theirs(full, host, b)
        sweep()
        if not np.allclose(sweeps.x.get(), host, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the sweep of {name} is not that of PyAMG")
        actions["pyamg"] = lambda: theirs(full, host, b)
    times = {key: value * 1e3 for key, value in seconds(actions, repeats=15).items()}
    sweeping, one = f"{name}, strips of {relax.block}", times["product"]
    rows = [
        Row.from_times(sweeping, "one product", one, times["sweep"], "ms", PRODUCT_TARGET),
        Row.from_times(
            f"{name}, block method", "one product", one, times["block"], "ms", PRODUCT_TARGET
        ),
    ]
    if theirs is not None:
        target = PYAMG_TARGETS.get(name, PYAMG_DENSE)
        rows.append(Row.from_times(sweeping, "pyamg", times["pyamg"], times["sweep"], "ms", target))
    return rows


def main() -> None:
    given = parse_options(__doc__ or "")
    n, per_row, dense = (2048, 32, 256) if given.smoke else (131072, 256, 4096)
    pyamg = importlib.util.find_spec("pyamg")  # the extra `bench` brings it
    theirs = pyamg and importlib.import_module("pyamg.relaxation.relaxation").gauss_seidel
    rows = []
    for name, run in (("runs of 16", 16), ("random", 1)):
        rows += compare(given, name, matrix(n, per_row, run), theirs)
    R = np.random.default_rng(2).random((dense, dense), dtype=np.float32) / dense
    rows += compare(given, f"dense {dense}", R, theirs)
    installed = "yes" if pyamg else "no: its rows are left out"
    report(
        given,
        "Gauss-Seidel sweep",
        rows,
        {"pixels": n, "nonzeros a row": per_row, "PyAMG": installed},
    )


if __name__ == "__main__":
    main()
