# SPDX-License-Identifier: BSD-3-Clause
"""Which projector pixel each camera pixel sees, and photographs on the projector's grid.

gray, phase            patterns, and what their photographs tell of each coordinate
classification         direct and indirect light; which bits are certain
consistency, subpixel  neighbours that do not fit; fractions of a pixel from the edges of stripes
correspondence         the map; `decode` makes it from photographs at hand
measure                drives a projector and a camera through the patterns
footprints, resample   what a camera pixel covers; photographs on the projector's grid, by area
sharpness              how much of a pixel's light comes out at its neighbours
unmixing, centring     projector pixels told apart by smaller camera pixels; averages about the middle
"""

from __future__ import annotations

from ltcl.acquisition.geometry.correspondence import Correspondence, decode
from ltcl.acquisition.geometry.gray import GrayCode
from ltcl.acquisition.geometry.measure import measure
from ltcl.acquisition.geometry.phase import PhaseShift
from ltcl.acquisition.geometry.resample import Resampling

__all__ = ["Correspondence", "GrayCode", "PhaseShift", "Resampling", "decode", "measure"]
