# SPDX-License-Identifier: BSD-3-Clause
"""Set-ups of a projector and a camera, each an `ltcl.acquisition.Rig`.

virtual     VirtualRig: photographs of a known T; camera_map: what a camera that is not aligned sees
mitsuba     MitsubaRig: photographs of a scene that Mitsuba 3 renders; both with the noise of sensor
folder      FolderRig: patterns and a shooting list out, photographs in; show: the patterns on a display
live        LiveRig: cameras before a display; survey tests both first, every frame is checked
"""

from __future__ import annotations

from ltcl.acquisition.rigs.cameras import GPhoto2Camera, OpenCVCamera
from ltcl.acquisition.rigs.display import Display
from ltcl.acquisition.rigs.folder import FolderRig
from ltcl.acquisition.rigs.live import LiveRig
from ltcl.acquisition.rigs.mitsuba import MitsubaRig, mitsuba_scene
from ltcl.acquisition.rigs.show import show
from ltcl.acquisition.rigs.virtual import VirtualRig, camera_map

__all__ = [
    "Display",
    "FolderRig",
    "GPhoto2Camera",
    "LiveRig",
    "MitsubaRig",
    "OpenCVCamera",
    "VirtualRig",
    "camera_map",
    "mitsuba_scene",
    "show",
]
