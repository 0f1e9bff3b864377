# SPDX-License-Identifier: BSD-3-Clause
"""Exchange of light between patches: what form factors must obey, and all bounces at once.

    T = (I - A)^-1 diag(r),    A = diag(r) F    (eq. 4),    F (N, N), albedo r (N,), area a (N,)

Reciprocity says that diag(a) F is symmetric. With s = sqrt(r / a) this gives

    B = diag(s) diag(a) F diag(s) = B^T,    T = diag(s) (I - B)^-1 diag(s) diag(a)

where I - B is positive definite for albedos below one. Cholesky inverts it with half the work of a
general inverse and in the memory of the result alone; black patches (r = 0) need no special case.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.errors import InputError
from ltcl.scenes.walls import check_albedo

_BLOCK = 512  # rows and columns touched at a time where a matrix meets its transpose
_TOLERANCE = 1e-6  # form factors found by quadrature or sampling are a little off


def checked(form_factors: Any, albedo: Any, area: Any, patches: int) -> dict[str, np.ndarray]:
    """The arrays of a scene by name, float64 and not writeable, if they are what `Scene` says.

    Raises
    ------
    InputError
        If a shape, an albedo or the form factors are wrong.
    """
    found = {}
    for name, given, shapes in (
        ("form_factors", form_factors, [(patches, patches)]),
        ("albedo", albedo, [(1, patches), (3, patches)]),
        ("area", area, [(patches,)]),
    ):
        value = checks.real(name, given).astype(np.float64, copy=False)
        # A view, so that the caller's own array stays writeable.
        found[name] = checks.finite(name, checks.shape(name, value, *shapes)).view()
        found[name].flags.writeable = False
    check_albedo(found["albedo"])
    check(found["form_factors"], found["area"])
    return found


def check(form_factors: np.ndarray, area: np.ndarray) -> None:
    """Refuse form factors that are negative, make light or break reciprocity, and areas of zero.

    Raises
    ------
    InputError
        For each of these, with the worst value.

    Examples
    --------
    >>> check(np.array([[0.0, 0.5], [0.25, 0.0]]), area=np.array([1.0, 2.0]))
    """
    if area.min() <= 0:
        raise InputError(f"area has the value {area.min():g}; all must be above 0")
    if form_factors.min() < 0:
        raise InputError(f"form_factors has the value {form_factors.min():g}; all must be at least 0")
    most = form_factors.sum(axis=1).max()
    if most > 1 + _TOLERANCE:
        raise InputError(f"form_factors has a row that sums to {most:g}; no patch can send out more than 1")
    worst, largest = 0.0, (area * form_factors.max(axis=1)).max()
    for rows, columns in _blocks(len(area)):
        there = area[rows, None] * form_factors[rows, columns]
        back = area[columns, None] * form_factors[columns, rows]
        worst = max(worst, np.abs(there - back.T).max())
    if worst > _TOLERANCE * largest:
        raise InputError(
            f"form_factors breaks reciprocity by {worst / largest:.2g} of the largest exchange; "
            "area_i F_ij must equal area_j F_ji"
        )


def transport(form_factors: np.ndarray, albedo: np.ndarray, area: np.ndarray) -> np.ndarray:
    """T = (I - A)^-1 diag(albedo), (N, N) float64, for one channel.

    Parameters
    ----------
    form_factors : ndarray, (N, N)
        Row i: where the light that leaves patch i goes; area_i F_ij = area_j F_ji.
    albedo, area : ndarray, (N,)
        Albedo in [0, 1), area above 0.

    Raises
    ------
    InputError
        If the gain of one bounce is 1 or more.

    Examples
    --------
    >>> mirrors = np.array([[0.0, 1.0], [1.0, 0.0]])
    >>> transport(mirrors, albedo=np.array([0.5, 0.5]), area=np.ones(2)).round(4)
    array([[0.6667, 0.3333],
           [0.3333, 0.6667]])
    """
    s = np.sqrt(albedo / area)
    matrix = form_factors * -s  # I - B, step by step in place
    matrix *= (s * area)[:, None]
    matrix[np.diag_indices_from(matrix)] += 1
    _invert(matrix)
    matrix *= s[:, None]
    matrix *= s * area
    return matrix


def _invert(matrix: np.ndarray) -> None:
    """Invert a symmetric positive definite matrix (N, N) in place."""
    potrf, potri = scipy.linalg.get_lapack_funcs(("potrf", "potri"), (matrix,))
    # LAPACK wants columns; of a symmetric matrix the transposed view will do, and saves a copy.
    columns, failed = potrf(matrix.T, lower=1, overwrite_a=1)
    if not failed:
        columns, failed = potri(columns, lower=1, overwrite_c=1)
    if failed:
        raise InputError("albedo and form_factors give a bounce a gain of 1 or more; lower the albedo")
    # The result stands in the upper triangle of the rows only.
    for rows, right in _blocks(len(matrix)):
        block = matrix[rows, right]
        if rows == right:
            block = np.triu(block) + np.triu(block, 1).T
            matrix[rows, right] = block
        matrix[right, rows] = block.T


def _blocks(size: int) -> list[tuple[slice, slice]]:
    """Blocks (rows, columns) that cover the upper triangle of a size x size matrix."""
    parts = [slice(start, min(start + _BLOCK, size)) for start in range(0, size, _BLOCK)]
    return [(rows, columns) for i, rows in enumerate(parts) for columns in parts[i:]]
