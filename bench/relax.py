# SPDX-License-Identifier: BSD-3-Clause
"""A sweep of Gauss-Seidel and of its block form, beside one product and beside PyAMG's.

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

from _harness import Options, Row, milliseconds, parse_options, product, report
from csr import matrix
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.relaxation import Sweeps, relaxation
from ltcl.solvers.relaxation import BlockGaussSeidel

# A sweep takes at most 1.15 times one product.
PRODUCT_TARGET = 1 / 1.15
# Times faster; PyAMG's own limit is the product.
PYAMG_TARGETS = {"runs of 16": 2.4, "random": 1.4}
PYAMG_DENSE_TARGET = 6.0


def full_matrix(R: Any) -> Any:
    """S = I + R in CSR, float32."""
    identity = scipy.sparse.eye_array(R.shape[0])
    S = scipy.sparse.csr_array(identity + scipy.sparse.csr_array(R))
    return S.astype(np.float32)


class SweepTimer:
    """Sweeps with one matrix on the device, and PyAMG's on the host."""

    def __init__(self, options: Options, R: Any) -> None:
        self.device = options.device
        self.R = R
        make = CSR if scipy.sparse.issparse(R) else Dense
        self.S = IdentityPlus(make(options.device, R))
        n = self.S.shape[0]
        self.b = np.random.default_rng(1).random(n, dtype=np.float32)
        relax = relaxation(self.S, "gauss_seidel")
        block_relax = relaxation(self.S, BlockGaussSeidel.name, BlockGaussSeidel().block, None)
        self.strip = relax.block
        self.sweeps = self.start(relax)
        self.block_sweeps = self.start(block_relax)

    def start(self, method: Any) -> Sweeps:
        """Sweeps of a method from x = 0."""
        x = self.device.upload(np.zeros(len(self.b), np.float32))
        b = self.device.upload(self.b)
        return Sweeps(method, x, b, b.like())

    def sweep(self, sweeps: Sweeps) -> None:
        """Run one sweep and wait for it."""
        sweeps.sweep()
        self.device.finish()

    def measure(self, pyamg_sweep: Callable | None) -> dict[str, float]:
        """Median milliseconds of a product and of sweeps, in turn."""
        actions: dict[str, Callable[[], object]] = {
            "product": product(self.S.R, self.b),
            "sweep": lambda: self.sweep(self.sweeps),
            "block": lambda: self.sweep(self.block_sweeps),
        }
        if pyamg_sweep is not None:
            actions["pyamg"] = self.checked_pyamg(pyamg_sweep)
        return milliseconds(actions, repeats=15)

    def checked_pyamg(self, pyamg_sweep: Callable) -> Callable[[], object]:
        """PyAMG's sweep, after the first ones of both were compared."""
        full = full_matrix(self.R)
        x = np.zeros(len(self.b), np.float32)
        pyamg_sweep(full, x, self.b)
        self.sweep(self.sweeps)
        if not np.allclose(self.sweeps.x.get(), x, rtol=1e-4, atol=1e-5):
            raise SystemExit(f"the sweep of {len(x)} pixels is not that of PyAMG")
        return lambda: pyamg_sweep(full, x, self.b)


def compare(options: Options, name: str, R: Any, pyamg_sweep: Callable | None) -> list[Row]:
    timer = SweepTimer(options, R)
    ms = timer.measure(pyamg_sweep)

    def row(question: str, competitor: str, key: str, ours: str, target: float) -> Row:
        return Row.from_times(question, competitor, ms[key], ms[ours], "ms", target)

    strips = f"{name}, strips of {timer.strip}"
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
    """PyAMG's Gauss-Seidel sweep, or None if it is not installed (the extra `bench` brings it)."""
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
