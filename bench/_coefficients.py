# SPDX-License-Identifier: BSD-3-Clause
"""R by the largest of its numbers: how many an error needs, and T from wavelet coefficients."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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

# Rows in a block; with more, the system hands out and takes back memory at every step.
ROWS = 64
# Halvings of an interval of 40 octaves, down to a 200th of an octave.
BISECTIONS = 13

note = Console(stderr=True).print


def analysis(W: Wavelet) -> Callable[[np.ndarray], np.ndarray]:
    """Return W as a function of arrays on the host, in float32."""

    def analyze(x: np.ndarray) -> np.ndarray:
        return W.apply(W.device.upload(x)).get()

    return analyze


def norms(arrays: Iterable[np.ndarray]) -> np.ndarray:
    """The norm of each array."""
    return np.array([np.linalg.norm(array) for array in arrays])


def relative_error(approximation: np.ndarray, exact: np.ndarray) -> float:
    """Error of (N,) or (N, k) in the norm over pixels, of the worst column."""
    error_norms = np.linalg.norm(approximation - exact, axis=0)
    return float(np.max(error_norms / np.linalg.norm(exact, axis=0)))


def keep_largest(matrix: Any, x: np.ndarray, y: np.ndarray, error: float) -> scipy.sparse.csr_array:
    """Drop small numbers of a matrix, dense or sparse, as an `error` of y = matrix @ x allows."""
    starts = range(0, matrix.shape[0], ROWS)
    blocks = [slice(start, start + ROWS) for start in starts]

    def product_error(threshold: float) -> float:
        products = []
        for rows in blocks:
            block = matrix[rows]
            products.append((block * (abs(block) >= threshold)) @ x)
        return relative_error(np.concatenate(products), y)

    largest = float(max(matrix.max(), -matrix.min()))
    threshold = bisect(product_error, error, largest)
    rest = [drop_below(matrix[rows], threshold)[0] for rows in blocks]
    return scipy.sparse.csr_array(scipy.sparse.vstack(rest, "csr"))


def bisect(error: Callable[[float], float], max_error: float, high: float) -> float:
    """About the largest threshold whose error is at most `max_error`; `high` drops everything."""
    low = high * 2.0**-40
    for _ in range(BISECTIONS):
        middle = float(np.sqrt(low * high))
        if error(middle) <= max_error:
            low = middle
        else:
            high = middle
    return low


def keep_fewest(C: Any, error: Callable[[Any], float], max_error: float) -> Any:
    """Drop as many small numbers of C as keep `error` of the rest at `max_error`."""

    def threshold_error(threshold: float) -> float:
        return error(drop_below(C, threshold)[0])

    largest = float(np.abs(C.data).max())
    threshold = bisect(threshold_error, max_error, largest)
    return drop_below(C, threshold)[0]


def transport(W: Wavelet, cores: Sequence[Any], albedo: Sequence[float]) -> ltcl.Transport:
    """T = (I + R) F with R = W^T C W for each colour, in tiles of 16 bits; F is the albedo."""
    rows, columns = W.grid
    F = np.repeat(np.array(albedo)[:, None], rows * columns, axis=1)
    operators = []
    for C, f in zip(cores, F, strict=True):
        core, V = restrict_to_support(C, W)
        R = Compressed(Tiles(W.device, core, 8, "float16"), V, V)
        operators.append(ScaledColumns(IdentityPlus(R), f))
    return ltcl.Transport(operators, W.grid, first_bounce=F)
