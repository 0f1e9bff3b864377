# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in linear light: files in and out, the sRGB curve, other grids; `frames` for films."""

from ltcl.images.pictures import BITS, from_srgb, read, read_codes, resize, to_srgb, write

__all__ = ["BITS", "from_srgb", "read", "read_codes", "resize", "to_srgb", "write"]
