# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports: R as few numbers between two bases, with a bound on solution errors."""

from __future__ import annotations

from ltcl.tasks.compression.basis_pairs import INVERSE_NAMES
from ltcl.tasks.compression.compress import compress
from ltcl.tasks.compression.fit import ChannelCompression, Compression, Trial
from ltcl.tasks.compression.invert import invert
from ltcl.tasks.compression.norms import inverse_norm
from ltcl.tasks.compression.sparse_inverse import SparseInverse, invert_coefficients

__all__ = [
    "INVERSE_NAMES",
    "ChannelCompression",
    "Compression",
    "SparseInverse",
    "Trial",
    "compress",
    "inverse_norm",
    "invert",
    "invert_coefficients",
]
