# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in linear light: files in and out, the sRGB curve, other grids; `frames` for films."""

from __future__ import annotations

from ltcl.images.io import BITS, read, read_codes, write
from ltcl.images.resize import resize
from ltcl.images.srgb import from_srgb, to_srgb

__all__ = ["BITS", "from_srgb", "read", "read_codes", "resize", "to_srgb", "write"]
