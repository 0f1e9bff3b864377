# SPDX-License-Identifier: BSD-3-Clause
"""Set-ups of a projector and a camera, each an `ltcl.acquisition.Rig`.

virtual     VirtualRig: photographs of a known T, made by sensor (noise, saturation, levels) and curves;
            camera_map is what a camera that is not aligned sees
mitsuba     MitsubaRig: photographs of a scene that Mitsuba 3 renders; mitsuba_scenes has corners and a room,
            mitsuba_loading puts the pattern in
folder      FolderRig: patterns and a shooting list out, photographs in; shooting_list keeps the numbers,
            arrivals finds the files, photographs and exif read them, sequence checks that they fit
live        LiveRig: cameras (OpenCV) or tethered (gphoto2) before a display; stage is both of them in time,
            survey tests them first, freshness checks every frame, periods the exposures
extras      what only some of these need, imported when they do
"""

from __future__ import annotations

from ltcl.acquisition.rigs.camera_map import camera_map
from ltcl.acquisition.rigs.cameras import Camera, OpenCVCamera
from ltcl.acquisition.rigs.display import Display
from ltcl.acquisition.rigs.folder import FolderRig
from ltcl.acquisition.rigs.live import LiveRig
from ltcl.acquisition.rigs.mitsuba import MitsubaRig
from ltcl.acquisition.rigs.mitsuba_scenes import mitsuba_scene
from ltcl.acquisition.rigs.tethered import GPhoto2Camera
from ltcl.acquisition.rigs.virtual import VirtualRig

__all__ = [
    "Camera",
    "Display",
    "FolderRig",
    "GPhoto2Camera",
    "LiveRig",
    "MitsubaRig",
    "OpenCVCamera",
    "VirtualRig",
    "camera_map",
    "mitsuba_scene",
]
