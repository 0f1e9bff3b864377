# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports: R as few numbers between two bases, with a bound on what a solution loses."""

from __future__ import annotations

from ltcl.compression.inverse_norm import inverse_norm
from ltcl.compression.inversion import invert
from ltcl.compression.iterated import Iterated
from ltcl.compression.iteration import invert_coefficients
from ltcl.compression.result import ChannelCompression, Compression, Trial
from ltcl.compression.sources import RowSource
from ltcl.compression.task import compress

__all__ = [
    "ChannelCompression",
    "Compression",
    "Iterated",
    "RowSource",
    "Trial",
    "compress",
    "inverse_norm",
    "invert",
    "invert_coefficients",
]
