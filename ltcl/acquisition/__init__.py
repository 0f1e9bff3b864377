# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a transport: what drives projectors and cameras, and what their pictures say.

task         acquire and finalize, by a `rig`: virtual, rendered, photographed by a person, on a
cable (rigs/) calibrate    what is measured once (`session`, radiometry/, geometry/); its record,
`calibration` scanning/    which pixels are lit when, and T from the pictures; plan before, report
after agreement    photographs that deviate from what others show are refused by number; `anchor`:
did it move? project      an acquisition as a folder with an acquisition.toml

Codes in [0, 1] are what a projector is fed and what a camera gives; they are not linear in light.
"""

from __future__ import annotations

from ltcl.acquisition.calibration import Calibration, Setup
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.project import Project
from ltcl.acquisition.rig import Rig, Shots
from ltcl.acquisition.rigs import (
    Display,
    FolderRig,
    GPhoto2Camera,
    LiveRig,
    MitsubaRig,
    OpenCVCamera,
    VirtualRig,
    camera_map,
)
from ltcl.acquisition.scanning.report import Report
from ltcl.acquisition.settings import ScanSettings
from ltcl.acquisition.task import acquire, finalize

__all__ = [
    "Calibration",
    "Correspondence",
    "Project",
    "Report",
    "Rig",
    "ScanSettings",
    "Setup",
    "Shots",
]
__all__ += [
    "Display",
    "FolderRig",
    "GPhoto2Camera",
    "LiveRig",
    "MitsubaRig",
    "OpenCVCamera",
    "VirtualRig",
]
__all__ += ["acquire", "camera_map", "finalize"]
