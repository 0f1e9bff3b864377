# SPDX-License-Identifier: BSD-3-Clause
"""Linear operators on an OpenCL device, each also a `scipy.sparse.linalg.LinearOperator`."""

from __future__ import annotations

from typing import Any

from ltcl.device import Device, open_device
from ltcl.operators.base import Epilogue, Norms, Operator
from ltcl.operators.bases import (
    Basis,
    SubsetBasis,
    multiresolution_order,
    restrict_to_support,
)
from ltcl.operators.compressed import Compressed
from ltcl.operators.coupled import Coupled
from ltcl.operators.csr import CSR, RowBlocks
from ltcl.operators.dense import Dense
from ltcl.operators.distributed import Distributed, rank_device
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.interreflection import interreflections
from ltcl.operators.multi_device import MultiDevice, upload_matrix
from ltcl.operators.out_of_core import Streamed, stays_on_disk
from ltcl.operators.parts import Parts
from ltcl.operators.pyramid import Pyramid
from ltcl.operators.scaled_columns import ScaledColumns
from ltcl.operators.scipy_operator import Host
from ltcl.operators.tiles import Tiles, smallest
from ltcl.operators.wavelets import Wavelet, basis

__all__ = [
    "CSR",
    "Basis",
    "Compressed",
    "Coupled",
    "Dense",
    "Distributed",
    "Epilogue",
    "Host",
    "IdentityPlus",
]
__all__ += [
    "MultiDevice",
    "Norms",
    "Operator",
    "Parts",
    "Pyramid",
    "RowBlocks",
    "ScaledColumns",
    "Streamed",
]
__all__ += ["SubsetBasis", "Tiles", "Wavelet", "as_operator", "basis", "interreflections"]
__all__ += ["multiresolution_order", "rank_device", "restrict_to_support", "smallest"]


def as_operator(matrix: Any, device: Device | None = None) -> Operator:
    """An operator on a device from whatever SciPy users hold.

    Parameters
    ----------
    matrix : Operator (returned as it is), (M, N) array, scipy.sparse matrix or array, or
    LinearOperator
    device : Device, the best one when not given

    Examples
    --------
    >>> import numpy
    >>> from ltcl.operators import as_operator
    >>> type(as_operator(numpy.eye(4))).__name__
    'Dense'
    """
    if isinstance(matrix, Operator):
        return matrix
    device = device if device is not None else open_device()
    if device.agreed(stays_on_disk([matrix], device)):
        return Streamed(device, matrix)
    if hasattr(matrix, "matvec") and not hasattr(matrix, "row_blocks"):
        return Host(device, matrix)
    return upload_matrix(device, matrix)
