# SPDX-License-Identifier: BSD-3-Clause
"""Linear operators on an OpenCL device, each also a `scipy.sparse.linalg.LinearOperator`."""

from __future__ import annotations

from ltcl.operators.base import Operator
from ltcl.operators.bases import (
    Basis,
    ScaledBasis,
    SubsetBasis,
    multiresolution_order,
    restrict_to_support,
)
from ltcl.operators.compressed import Compressed
from ltcl.operators.conversion import as_operator
from ltcl.operators.coupled import Coupled
from ltcl.operators.csr import CSR, RowBlocks
from ltcl.operators.dense import Dense, Filled
from ltcl.operators.diagonal_blocks import BlockDiagonal, Planes, block_diagonal
from ltcl.operators.distributed import Distributed, rank_device
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.interreflection import interreflections
from ltcl.operators.knowledge import Norms
from ltcl.operators.multi_device import MultiDevice
from ltcl.operators.out_of_core import Streamed
from ltcl.operators.parts import Parts
from ltcl.operators.patch_hats import PatchHats
from ltcl.operators.product import Product
from ltcl.operators.pyramid import Hats, Pyramid
from ltcl.operators.scaled_columns import ScaledColumns
from ltcl.operators.scipy_operator import Host
from ltcl.operators.tiles import Tiles, smallest
from ltcl.operators.wavelets import Wavelet, basis

__all__ = [
    "CSR",
    "Basis",
    "BlockDiagonal",
    "Compressed",
    "Coupled",
    "Dense",
    "Distributed",
    "Epilogue",
    "Filled",
    "Hats",
    "Host",
    "IdentityPlus",
    "MultiDevice",
    "Norms",
    "Operator",
    "Parts",
    "PatchHats",
    "Planes",
    "Product",
    "Pyramid",
    "RowBlocks",
    "ScaledBasis",
    "ScaledColumns",
    "Streamed",
    "SubsetBasis",
    "Tiles",
    "Wavelet",
    "as_operator",
    "basis",
    "block_diagonal",
    "interreflections",
    "multiresolution_order",
    "rank_device",
    "restrict_to_support",
    "smallest",
]
