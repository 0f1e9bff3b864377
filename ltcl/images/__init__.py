# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in linear light, as files and as arrays.

encoding     codes and linear light; the sRGB curve
decoders     picture files of every format as codes
pictures     read, write and resize pictures
frames       folders of pictures and videos, frame by frame
thumbnails   small pictures in HTML for notebooks
"""

from ltcl.images.encoding import from_srgb, to_srgb
from ltcl.images.pictures import BITS, read, read_codes, resize, write, write_codes

__all__ = ["BITS", "from_srgb", "read", "read_codes", "resize", "to_srgb", "write", "write_codes"]
