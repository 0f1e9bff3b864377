# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports: R as few numbers between two bases, with a bound on what a solution loses."""

from __future__ import annotations

from ltcl.tasks.compression.coefficients import INVERSE_NAMES
from ltcl.tasks.compression.compress import ChannelCompression, Compression, Trial, compress
from ltcl.tasks.compression.invert import SparseInverse, invert, invert_coefficients
from ltcl.tasks.compression.losses import inverse_norm

__all__ = [
    "INVERSE_NAMES",
    "ChannelCompression",
    "Compression",
    "SparseInverse",
    "Trial",
    "compress",
]
__all__ += ["inverse_norm", "invert", "invert_coefficients"]
