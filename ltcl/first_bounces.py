# SPDX-License-Identifier: BSD-3-Clause
"""The first bounce F, found from a measured T = S F (eq. 3), and what to do where it is dark."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError, InputTypeError

_BYTES = 3 * 8  # of a dense inverse, per entry: the matrix, its inverse and what LAPACK works with


def find(matrices: Sequence[Any], wanted: Any) -> np.ndarray:
    """F of each channel, (channels, N) float64, not yet checked for sign; not "estimate"."""
    n = matrices[0].shape[0]
    if isinstance(wanted, str):
        checks.one_of("first_bounce", wanted, ("diagonal", "exact", "estimate"))
        find = _diagonal if wanted == "diagonal" else _exact
        return np.stack([find(matrix) for matrix in matrices])
    F = checks.finite("first_bounce", checks.real("first_bounce", wanted)).astype(np.float64)
    checks.shape("first_bounce", F, *([(n,), (1, n)] if len(matrices) == 1 else [(n,), (3, n)]))
    return np.broadcast_to(F, (len(matrices), n))


def undone(columns: Sequence[np.ndarray], F: np.ndarray, mixing: np.ndarray | None) -> list[np.ndarray]:
    """Projector light F^-1 l_d from direct components (N, k) of each channel; 0 where F is.

    >>> undone([np.array([[0.2], [0.3]])], np.array([[0.5, 0.0]]), None)[0].tolist()
    [[0.4], [0.0]]
    """
    light = [
        np.divide(l_d, f[:, None], out=np.zeros(l_d.shape), where=f[:, None] > 0)
        for l_d, f in zip(columns, F, strict=True)
    ]
    return light if mixing is None else list(np.einsum("ij,jnk->ink", np.linalg.inv(mixing), light))


def too_large(matrix: Any) -> bool:
    """Whether "exact" would invert more than the host has memory for."""
    n = matrix.shape[0]
    return _BYTES * n * n > checks.host_memory()


def _diagonal(matrix: Any) -> np.ndarray:
    if callable(getattr(matrix, "diagonal", None)):
        return np.asarray(matrix.diagonal(), np.float64)
    raise InputError(
        f"first_bounce is 'diagonal', but a {type(matrix).__name__} does not tell its diagonal; "
        "give first_bounce as an array (N,)"
    )


def _exact(matrix: Any) -> np.ndarray:
    """F_ii = 1 / (T^-1)_ii: of T^-1 = F^-1 (I - A) the diagonal is 1 / F where A has none."""
    if not isinstance(matrix, (np.ndarray, scipy.sparse.csr_array)):
        raise InputTypeError(
            f"first_bounce='exact' inverts the matrix densely, which a {type(matrix).__name__} does not "
            "allow; give 'estimate', or first_bounce as an array (N,)"
        )
    n = len(matrix.indptr) - 1 if isinstance(matrix, scipy.sparse.csr_array) else len(matrix)
    checks.fits_host(f"first_bounce='exact' inverts T densely, which for N = {n}", _BYTES * n * n)
    dense = (matrix if isinstance(matrix, np.ndarray) else matrix.toarray()).astype(np.float64)
    lit = dense.any(axis=0) & dense.any(axis=1)  # a dark pixel would make T singular; its F is 0
    if not lit.all():
        dense = dense[np.ix_(lit, lit)]
    try:
        inverse = scipy.linalg.inv(dense, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "first_bounce is 'exact', which needs an invertible T, but this one is singular; "
            "give 'diagonal' or an array (N,)"
        ) from error
    with np.errstate(divide="ignore"):
        found = 1.0 / np.diagonal(inverse)
    F = np.zeros(n)
    F[lit] = np.where(np.isfinite(found), found, 0.0)
    return F


def refuse_dark(dark: np.ndarray, grid: tuple[int, int], on_dark: str, maskable: bool) -> None:
    """Refuse pixels without a positive first bounce, unless they may be masked and this T is `maskable`."""
    pixels = np.flatnonzero(dark.any(axis=0))
    if len(pixels) == dark.shape[1]:
        raise InputError(
            "first_bounce is zero or negative at every pixel; it must be positive where light falls: "
            "check the sign and the black level of T"
        )
    if on_dark == "mask" and maskable:
        return
    listed = ", ".join(f"({pixel // grid[1]}, {pixel % grid[1]})" for pixel in pixels[:8])
    more = f" and {len(pixels) - 8} more" if len(pixels) > 8 else ""
    advice = "give on_dark='mask' to leave these pixels unlit"
    if on_dark == "mask":
        advice = "a LinearOperator cannot be masked here, mask it yourself"
    raise InputError(
        f"first_bounce is zero or negative at {len(pixels)} of {dark.shape[1]} pixels (row, column): "
        f"{listed}{more}; it must be positive; {advice}"
    )


def certain(F: np.ndarray, variance: np.ndarray, sigmas: float) -> np.ndarray:
    """`F` where it is above 0 by so many standard deviations, else 0: a pixel to be masked.

    With noise for F, S = T F^-1 would be anything. What has a variance of NaN is not certain.

    >>> certain(np.array([4.0, 2.0, -4.0, 4.0]), np.array([1.0, 1.0, 1.0, np.nan]), 3.0).tolist()
    [4.0, 0.0, 0.0, 0.0]
    """
    return np.where(sigmas * np.sqrt(variance) < F, F, 0.0)
