# SPDX-License-Identifier: BSD-3-Clause
"""Set-ups of a projector and a camera, each an `ltcl.acquisition.Rig`.

virtual     VirtualRig: photographs of a known T, made by sensor (noise, saturation, levels) and curves
folder      FolderRig: patterns and a shooting list out, photographs in; shooting_list keeps the numbers,
            arrivals finds the files, photographs and exif read them, sequence checks that they fit
"""

from __future__ import annotations

from ltcl.acquisition.rigs.folder import FolderRig
from ltcl.acquisition.rigs.virtual import VirtualRig

__all__ = ["FolderRig", "VirtualRig"]
