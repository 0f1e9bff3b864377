# SPDX-License-Identifier: BSD-3-Clause
"""Set-ups of a projector and a camera, each an `ltcl.acquisition.Rig`; `show` of patterns on a display."""

from __future__ import annotations

from ltcl.acquisition.rigs.cameras import GPhoto2Camera, OpenCVCamera
from ltcl.acquisition.rigs.display import Display, show
from ltcl.acquisition.rigs.folder import FolderRig
from ltcl.acquisition.rigs.live import LiveRig
from ltcl.acquisition.rigs.mitsuba import MitsubaRig
from ltcl.acquisition.rigs.virtual import VirtualRig, camera_map

__all__ = [
    "Display",
    "FolderRig",
    "GPhoto2Camera",
    "LiveRig",
    "MitsubaRig",
    "OpenCVCamera",
    "VirtualRig",
]
__all__ += ["camera_map", "show"]
