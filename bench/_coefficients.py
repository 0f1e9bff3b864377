# SPDX-License-Identifier: BSD-3-Clause
"""R by the largest of its numbers: how many of them an error takes, and T of R on wavelet coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse
from rich.console import Console

import ltcl
from ltcl.operators import (
    Compressed,
    IdentityPlus,
    ScaledColumns,
    Tiles,
    Wavelet,
    restrict_to_support,
)
from ltcl.tasks.compression.coefficients import drop_below

ROWS = 64  # more, and the system hands out and takes back memory at every step

note = Console(stderr=True).print


def analysis(W: Wavelet) -> Callable[[np.ndarray], np.ndarray]:
    """W of arrays on the host, in float32."""
    return lambda x: W.apply(W.device.upload(x)).get()


def relative_error(found: np.ndarray, exact: np.ndarray) -> float:
    """Error of (N,) or (N, k) in the norm over pixels, of the worst column."""
    return float(np.max(np.linalg.norm(found - exact, axis=0) / np.linalg.norm(exact, axis=0)))


def keep_largest(matrix: Any, x: np.ndarray, y: np.ndarray, error: float) -> scipy.sparse.csr_array:
    """As few of the largest numbers of a matrix, dense or sparse, as keep `error` of y = matrix @ x."""
    blocks = [slice(start, start + ROWS) for start in range(0, matrix.shape[0], ROWS)]

    def of_product(threshold: float) -> float:
        products = [(matrix[rows] * (abs(matrix[rows]) >= threshold)) @ x for rows in blocks]
        return relative_error(np.concatenate(products), y)

    threshold = bisect(of_product, error, float(max(matrix.max(), -matrix.min())))
    kept = [drop_below(matrix[rows], threshold)[0] for rows in blocks]
    return scipy.sparse.csr_array(scipy.sparse.vstack(kept, format="csr"))


def bisect(error: Callable[[float], float], wanted: float, high: float) -> float:
    """About the largest threshold whose error is at most `wanted`; `high` drops everything."""
    low = high * 2.0**-40
    for _ in range(13):  # to a 200th of an octave
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if error(middle) <= wanted else (low, middle)
    return low


def keep_fewest(C: Any, error: Callable[[Any], float], wanted: float) -> Any:
    """As few of the largest numbers of C as keep `error` of them at `wanted`."""
    threshold = bisect(lambda t: error(drop_below(C, t)[0]), wanted, float(np.abs(C.data).max()))
    return drop_below(C, threshold)[0]


def transport(W: Wavelet, cores: Sequence[Any], albedo: Sequence[float]) -> ltcl.Transport:
    """T = (I + R) F of an R = W^T C W for each colour, in tiles of 16 bits; F is the albedo."""
    systems = []
    for C in cores:
        core, V = restrict_to_support(C, W)
        systems.append(IdentityPlus(Compressed(Tiles(W.device, core, 8, "float16"), V, V)))
    F = np.repeat(np.array(albedo)[:, None], W.grid[0] * W.grid[1], axis=1)
    return ltcl.Transport(
        [ScaledColumns(S, f) for S, f in zip(systems, F, strict=True)], W.grid, first_bounce=F
    )
