# SPDX-License-Identifier: BSD-3-Clause
"""A Gauss-Seidel sweep, beside one product with the same matrix and beside PyAMG's; and block Gauss-Seidel.

S = I + R with N = 131072 pixels and 256 nonzeros a row, in runs of 16 neighbours and at random, and
a dense R of 4096 pixels. Ours is timed with vectors on the device, as inside a solve; PyAMG relaxes
S in CSR, in float32 like ours. Block Gauss-Seidel is another method, of which a sweep is timed.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from _harness import Options, Row, parse_options, product, report, seconds
from csr import matrix
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.relaxation import Sweeps, relaxation
from ltcl.solvers.relaxation import BlockGaussSeidel

# A sweep takes at most 1.1 times one product.
PRODUCT_TARGET = 1 / 1.1
# Times faster; PyAMG's own limit is the product.
PYAMG_TARGETS = {"runs of 16": 2.4, "random": 1.4}
PYAMG_DENSE_TARGET = 6.0


def full_matrix(R: Any) -> scipy.sparse.csr_array:
    """S = I + R in CSR, float32."""
    identity = scipy.sparse.eye_array(R.shape[0])
    S = scipy.sparse.csr_array(identity + scipy.sparse.csr_array(R))
    return S.astype(np.float32)


def compare(options: Options, name: str, R: Any, pyamg_sweep: Callable | None) -> list[Row]:
    is_sparse = scipy.sparse.issparse(R)
    operator = CSR(options.device, R) if is_sparse else Dense(options.device, R)
    S = IdentityPlus(operator)
    n = S.shape[0]
    b = np.random.default_rng(1).random(n, dtype=np.float32)
    device_b = options.device.upload(b)
    relax = relaxation(S, "gauss_seidel")
    block_relax = relaxation(S, BlockGaussSeidel.name, BlockGaussSeidel().block, None)

    def start(how: Any) -> Sweeps:
        x = options.device.upload(np.zeros(n, np.float32))
        return Sweeps(how, x, device_b, device_b.like())

    sweeps = start(relax)
    block_sweeps = start(block_relax)

    def sweep(sweeps: Sweeps) -> None:
        sweeps.sweep()
        options.device.finish()

    actions: dict[str, Callable[[], object]] = {
        "product": product(S.R, b),
        "sweep": lambda: sweep(sweeps),
        "block": lambda: sweep(block_sweeps),
    }
    if pyamg_sweep is not None:
        full = full_matrix(R)
        x = np.zeros(n, np.float32)
        pyamg_sweep(full, x, b)
        sweep(sweeps)
        if not np.allclose(sweeps.x.get(), x, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the sweep of {name} is not that of PyAMG")
        actions["pyamg"] = lambda: pyamg_sweep(full, x, b)
    ms = {key: 1e3 * spent for key, spent in seconds(actions, repeats=15).items()}

    def row(question: str, competitor: str, key: str, ours: str, target: float) -> Row:
        return Row.from_times(question, competitor, ms[key], ms[ours], "ms", target)

    strips = f"{name}, strips of {relax.block}"
    block_method = f"{name}, block method"
    rows = [
        row(strips, "one product", "product", "sweep", PRODUCT_TARGET),
        row(block_method, "one product", "product", "block", PRODUCT_TARGET),
    ]
    if pyamg_sweep is not None:
        target = PYAMG_TARGETS.get(name, PYAMG_DENSE_TARGET)
        rows.append(row(strips, "pyamg", "pyamg", "sweep", target))
    return rows


def find_pyamg_sweep() -> Callable | None:
    """PyAMG's Gauss-Seidel sweep, or None if PyAMG is not installed (the extra `bench` brings it)."""
    if importlib.util.find_spec("pyamg") is None:
        return None
    return importlib.import_module("pyamg.relaxation.relaxation").gauss_seidel


def main() -> None:
    options = parse_options(__doc__)
    n, per_row, dense = (2048, 32, 256) if options.smoke else (131072, 256, 4096)
    pyamg_sweep = find_pyamg_sweep()
    rows = compare(options, "runs of 16", matrix(n, per_row, 16), pyamg_sweep)
    rows += compare(options, "random", matrix(n, per_row, 1), pyamg_sweep)
    R = np.random.default_rng(2).random((dense, dense), dtype=np.float32) / dense
    rows += compare(options, f"dense {dense}", R, pyamg_sweep)
    installed = "no: its rows are left out" if pyamg_sweep is None else "yes"
    facts = {"pixels": n, "nonzeros a row": per_row, "PyAMG": installed}
    report(options, "Gauss-Seidel sweep", rows, facts)


if __name__ == "__main__":
    main()
