# SPDX-License-Identifier: BSD-3-Clause
"""Set-ups of a projector and a camera, each an `ltcl.acquisition.Rig`.

folder          a person photographs; patterns and photographs are files
shooting_list   shots that a person is to take
live            a camera on a cable photographs a display
link            commands to camera and display, in time
survey          what a live rig measures before its first photograph
cameras         cameras that OpenCV or gphoto2 opens
display         a display in full screen; `show` of a folder of patterns there
photographs     files of a camera as codes
memory_card     the order in which a camera took its files
simulated       sensor and projector curve of a computed scene
virtual         a scene of known light transport
camera_maps     parts of projector pixels that camera pixels see
mitsuba         a rendered scene
"""

from __future__ import annotations

from ltcl.acquisition.rigs.camera_maps import camera_map
from ltcl.acquisition.rigs.cameras import GPhoto2Camera, OpenCVCamera
from ltcl.acquisition.rigs.display import Display, show
from ltcl.acquisition.rigs.folder import FolderRig
from ltcl.acquisition.rigs.live import LiveRig
from ltcl.acquisition.rigs.mitsuba import MitsubaRig
from ltcl.acquisition.rigs.virtual import VirtualRig

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
