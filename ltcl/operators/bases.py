# SPDX-License-Identifier: BSD-3-Clause
"""Bases in which pictures have other coefficients than pixels."""

from __future__ import annotations

from ltcl.operators.base import Operator


class Basis(Operator):
    """W of shape (M, N): `apply` is analysis, pixels to coefficients, `apply_transpose` synthesis.

    Attributes
    ----------
    grid : (h, w)
        Of the pictures.
    name : str
    orthonormal : bool
        Whether W W^T = W^T W = I.
    """

    grid: tuple[int, int]
    name: str
    orthonormal: bool
