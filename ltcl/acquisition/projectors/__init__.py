# SPDX-License-Identifier: BSD-3-Clause
"""Several projectors before one camera, scanned one by one onto pixels that they share.

Pixels of T are squares of camera pixels, the same for all projectors, so that their T can be
combined. A pattern on these pixels is shown by a projector pixel that the camera sees there:

    view        which projector pixel each camera pixel sees, by Gray code, once for each projector
    warp        from the pixels of T to those of a projector
    rig         a projector that takes patterns on the pixels of T, for `ltcl.acquire`
    movement    did the camera move between two scans?
    combined    finished scans as one transport, with what the projectors are to be fed
"""

from __future__ import annotations

from ltcl.acquisition.projectors.combined import CombinedSetup, combine_scans
from ltcl.acquisition.projectors.movement import CameraMoved, check_camera
from ltcl.acquisition.projectors.rig import WarpedRig
from ltcl.acquisition.projectors.view import ProjectorView, measure_view, read_view
from ltcl.acquisition.projectors.warp import Warp, camera_geometry

__all__ = [
    "CameraMoved",
    "CombinedSetup",
    "ProjectorView",
    "Warp",
    "WarpedRig",
    "camera_geometry",
    "check_camera",
    "combine_scans",
    "measure_view",
    "read_view",
]
