# SPDX-License-Identifier: BSD-3-Clause
"""Monotone cubic splines on [0, 1] with the value 1 at 1, and least squares over them.

Knots lie closer to both ends, as toe and shoulder of a film curve need. With coefficients that never fall a
B-spline never falls, so that a fit is a non-negative least squares problem in a few dozen steps between them.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
import scipy.optimize
from scipy.interpolate import BSpline

_DEGREE, _INTERVALS = 3, 24
_LEAST_STEP = 1e-7  # of a coefficient over the one before: strictly monotone
_KNOTS = np.concatenate(
    [
        np.zeros(_DEGREE),
        (1.0 - np.cos(np.pi * np.arange(_INTERVALS + 1) / _INTERVALS)) / 2.0,
        np.ones(_DEGREE),
    ]
)
SIZE = _INTERVALS + _DEGREE
"""Coefficients of a curve."""
PLACES = np.array([_KNOTS[i + 1 : i + 1 + _DEGREE].mean() for i in range(SIZE)])
"""Where each coefficient acts (Greville's abscissae): with theta = PLACES the curve is the identity."""


def design(codes: np.ndarray) -> np.ndarray:
    """B with curve(codes) = B @ theta: (len(codes), SIZE)."""
    return BSpline.design_matrix(np.clip(codes, 0.0, 1.0), _KNOTS, _DEGREE).toarray()


def tabulate(theta: np.ndarray, count: int) -> np.ndarray:
    """The curve at `count` equally spaced codes."""
    return design(np.linspace(0.0, 1.0, count)) @ theta


def bends(theta: np.ndarray) -> np.ndarray:
    """D with D @ theta the relative change of slope from one coefficient to the next, at this theta."""
    slopes = np.diff(np.eye(SIZE), axis=0) / np.diff(PLACES)[:, None]
    size = np.maximum(slopes @ theta, 1e-3)
    return np.diff(slopes, axis=0) / np.minimum(size[1:], size[:-1])[:, None]


def fit(M: np.ndarray, v: np.ndarray, anchor: np.ndarray, value: float) -> np.ndarray:
    """Minimise theta^T M theta + 2 v^T theta over monotone curves that are `value` at `anchor`.

    M is symmetric and positive. The curve is scaled to 1 at the code 1 afterwards: a scale set there, where
    hardly any pixel tells of the curve, would be bought by a jump at the end.
    """
    # theta = value + P d: P d sums the steps up to each coefficient, less the curve of that at the anchor.
    P = np.tril(np.ones((SIZE, SIZE)), -1)[:, :-1]
    P = P - design(anchor) @ P
    level = np.full(SIZE, value)
    H, g = P.T @ M @ P, -P.T @ (M @ level + v)
    g = g - H @ np.full(SIZE - 1, _LEAST_STEP)
    scale = 1.0 / np.sqrt(np.diagonal(H))
    # NumPy's has OpenBLAS start threads for these few numbers: 0.05 ms become 20 where the cores are busy.
    values, vectors = scipy.linalg.eigh(H * scale * scale[:, None])
    root = np.sqrt(np.maximum(values, values[-1] * 1e-14))
    steps, _ = scipy.optimize.nnls(root[:, None] * vectors.T, (vectors.T @ (g * scale)) / root, maxiter=1000)
    theta = level + P @ (steps * scale + _LEAST_STEP)
    return theta / theta[-1]
