# SPDX-License-Identifier: BSD-3-Clause
"""Calls that a GPU is asked for: products, transforms, sweeps, solves and frames.

Each case makes an action on a device, with all that a loop over it prepares once done before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

import ltcl
import video
from _harness import Options, product
from csr import matrix
from ltcl.operators import CSR, Dense, IdentityPlus, Operator, Tiles, Wavelet
from ltcl.operators.relaxation import Sweeps, relaxation

Action = Callable[[], object]
RTOL = 1e-2
# Spectral radius of the R of solves.
SPECTRAL_RADIUS = 0.8


@dataclass(frozen=True)
class Case:
    """A call by name; `make` prepares it on a device.

    `csr_bytes` are those that the same product takes of a matrix in CSR, if there is one.
    """

    name: str
    make: Callable[[Options], Action]
    csr_bytes: Callable[[Options], int] | None = None


def sparse_size(options: Options) -> tuple[int, int]:
    """Rows of the sparse matrices, and their nonzeros a row."""
    return (2048, 32) if options.smoke else (131072, 256)


def sparse_rows(options: Options, run: int = 16) -> scipy.sparse.csr_array:
    """131072 pixels with 256 nonzeros a row, in runs; row sums are the spectral radius."""
    A = matrix(*sparse_size(options), run)
    sums = A.sum(axis=1)
    scales = scipy.sparse.diags_array(SPECTRAL_RADIUS / sums)
    return scipy.sparse.csr_array((scales @ A).astype(np.float32))


def dense_rows(options: Options) -> np.ndarray:
    """4096 pixels whose light goes everywhere."""
    n = 256 if options.smoke else 4096
    return np.full((n, n), SPECTRAL_RADIUS / n, np.float32)


def random_columns(A: Operator, k: int) -> np.ndarray:
    """Random numbers, (N,) or (N, k)."""
    shape = (A.shape[1],) if k == 1 else (A.shape[1], k)
    return np.random.default_rng(1).random(shape, dtype=np.float32)


def product_case(name: str, make: Callable[[Options], Operator], k: int) -> Case:
    """A product with k right-hand sides on the device."""

    def prepare(options: Options) -> Action:
        A = make(options)
        return product(A, random_columns(A, k))

    return Case(f"product: {name}, k = {k}", prepare)


def sparse_product_case(name: str, make: Callable[[Options], Operator], k: int) -> Case:
    """A product with the sparse matrix, of which CSR holds values and columns of 4 bytes."""

    def csr_bytes(options: Options) -> int:
        rows, row_nonzeros = sparse_size(options)
        numbers = 2 * rows * row_nonzeros + rows + 1 + 2 * rows * k
        return 4 * numbers

    return replace(product_case(name, make, k), csr_bytes=csr_bytes)


def csr(options: Options) -> Operator:
    return CSR(options.device, sparse_rows(options))


def tiles(options: Options) -> Operator:
    return Tiles(options.device, sparse_rows(options), 8, "float16")


def dense(options: Options) -> Operator:
    return Dense(options.device, dense_rows(options))


def transform(options: Options) -> Action:
    """Wavelet coefficients of a picture in colour, 256 x 512."""
    grid = (32, 64) if options.smoke else (256, 512)
    W = Wavelet(options.device, grid, "db2")
    return product(W, random_columns(W, 3))


def sweep(options: Options) -> Action:
    """A sweep of Gauss-Seidel."""
    S = IdentityPlus(csr(options))
    b = options.device.upload(random_columns(S, 1))
    x = options.device.upload(np.zeros(S.shape[0], np.float32))
    sweeps = Sweeps(relaxation(S, "gauss_seidel"), x, b, b.like())

    def run() -> None:
        sweeps.sweep()
        options.device.finish()

    return run


def solve_case(name: str, make: Callable[[Options], Operator], k: int) -> Case:
    """A solve as it is called, with transfers."""

    def prepare(options: Options) -> Action:
        S = IdentityPlus(make(options))
        b = random_columns(S, k)
        return lambda: ltcl.solve(S, b, rtol=RTOL)

    return Case(f"solve to 1 %: {name}, k = {k}", prepare)


def frame_case(name: str, *, keeps_inverse: bool) -> Case:
    """A frame of a film, from codes to codes, with a kept inverse or with a solve."""

    def prepare(options: Options) -> Action:
        grid, coarse = ((32, 64), (8, 16)) if options.smoke else ((256, 512), (32, 64))
        T = video.transport(options, grid, coarse)
        (codes,) = video.film(T, 1)
        inverse = ltcl.invert(T, RTOL) if keeps_inverse else None
        compensator = ltcl.Compensator(T, inverse=inverse, rtol=RTOL, clamp=True)
        return lambda: compensator(codes)

    return Case(f"frame: {name}", prepare)


CASES = [
    sparse_product_case("CSR, 131072 x 256", csr, 1),
    sparse_product_case("CSR, 131072 x 256", csr, 3),
    sparse_product_case("CSR, 131072 x 256", csr, 8),
    sparse_product_case("tiles of 16 bits", tiles, 1),
    product_case("dense, 4096", dense, 1),
    Case("wavelet transform, 256 x 512, k = 3", transform),
    Case("sweep of Gauss-Seidel, 131072 x 256", sweep),
    solve_case("CSR, 131072 x 256", csr, 1),
    solve_case("CSR, 131072 x 256", csr, 3),
    solve_case("dense, 4096", dense, 1),
    frame_case("256 x 512 RGB, kept inverse", keeps_inverse=True),
    frame_case("256 x 512 RGB, solve to 1 %", keeps_inverse=False),
]
