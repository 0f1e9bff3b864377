# SPDX-License-Identifier: BSD-3-Clause
"""Which projector pixel each camera pixel sees, and photographs on the projector's grid.

graycode         patterns, and the coordinates that their photographs give
correspondence   the map; `decode` makes it from photographs
resample         photographs on the projector's grid: its pixels separated by smaller camera pixels
sharpness        how much of a pixel's light comes out at its neighbours
"""

from __future__ import annotations

from ltcl.acquisition.geometry.correspondence import Correspondence, decode
from ltcl.acquisition.geometry.graycode import GrayCode
from ltcl.acquisition.geometry.resample import Resampling
from ltcl.acquisition.geometry.sharpness import Sharpness

__all__ = ["Correspondence", "GrayCode", "Resampling", "Sharpness", "decode"]
