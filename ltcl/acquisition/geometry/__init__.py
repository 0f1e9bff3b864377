# SPDX-License-Identifier: BSD-3-Clause
"""Map from camera pixels to projector pixels, and photographs on the projector's grid.

graycode         patterns, and the coordinates that their photographs give
correspondence   the map; `decode` makes it from photographs
subpixel         fractions of a pixel, by planes through the edges of stripes
resample         photographs on the projector's grid
footprints       areas of projector pixels that camera pixels see
blocks           projector pixels in square blocks
sharpness        how much of a pixel's light appears at its neighbours
"""

from __future__ import annotations

from ltcl.acquisition.geometry.correspondence import Correspondence, decode
from ltcl.acquisition.geometry.graycode import GrayCode
from ltcl.acquisition.geometry.resample import Resampling
from ltcl.acquisition.geometry.sharpness import Sharpness

__all__ = ["Correspondence", "GrayCode", "Resampling", "Sharpness", "decode"]
