# SPDX-License-Identifier: BSD-3-Clause
"""Operators on a device from arrays, sparse matrices and operators of SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.device import Device, open_device
from ltcl.operators.base import Operator
from ltcl.operators.dense import Dense
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.multi_device import upload_matrix
from ltcl.operators.out_of_core import Streamed, stays_on_disk
from ltcl.operators.scipy_operator import Host


def as_operator(matrix: Any, device: Device | None = None) -> Operator:
    """An operator on a device from any matrix of SciPy users.

    Parameters
    ----------
    matrix : Operator, (M, N) array, scipy.sparse matrix or array, or LinearOperator
        An Operator is returned as it is.
    device : Device, optional
        The best one when not given.

    Examples
    --------
    >>> import numpy
    >>> from ltcl.operators import as_operator
    >>> type(as_operator(numpy.eye(4))).__name__
    'Dense'
    """
    if isinstance(matrix, Operator):
        return matrix
    if device is None:
        device = open_device()
    if device.agreed(stays_on_disk([matrix], device)):
        return Streamed(device, matrix)
    if hasattr(matrix, "matvec") and not hasattr(matrix, "row_blocks"):
        return Host(device, matrix)
    return upload_matrix(device, matrix)


def as_exact_operator(matrix: Any, device: Device | None = None) -> Operator:
    """`as_operator`, whose float64 products use an array as it was before it became float32.

    The array must not change as long as the operator lives.
    """
    A = as_operator(matrix, device)
    if isinstance(A, Dense) and A is not matrix:
        A.exact_form = Float64Form(matrix=np.asarray(matrix))
    return A
