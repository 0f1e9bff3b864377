# SPDX-License-Identifier: BSD-3-Clause
"""Measure a transport by photographs: rigs, calibration, scans.

    task          acquire and finalize, with the `settings` of a scan, by a `rig`: virtual,
                  rendered, photographed by a person, on a cable (rigs/)
    calibrate     facts that are measured once (`metering`, `session`, radiometry/, geometry/), and
                  their checks (`consistency`); its record, `calibration`; pictures of the
                  camera's full resolution wait in a file (`scratch`, `radiance`)
    scanning/     patterns in order, and T from the pictures; a plan before, a report after
    estimation/   T from any pairs of pictures and photographs
    captures/     photographs of Gray code that other programs took
    updating/     a finished scan carried over by 12 photographs, after a nudge
    agreement     photographs that deviate from the others are refused by number; `anchor`: did
                  anything move?
    project       an acquisition as a folder with an acquisition.toml, whose tables `project_file`
                  checks
    several       the scans of several projectors one by one, onto pixels that they share, which
                  projectors/ has

Codes in [0, 1] are fed to a projector and come from a camera; they are not linear in light.
"""

from __future__ import annotations

from ltcl.acquisition.alignment import Alignment, align
from ltcl.acquisition.calibration import Calibration, Setup
from ltcl.acquisition.captures import Capture, PhotographOrder, import_gray_code
from ltcl.acquisition.estimation.fit import Fit, fit
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.project import Project
from ltcl.acquisition.projectors import CombinedSetup, combine_scans
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
from ltcl.acquisition.updating.task import Update, update

__all__ = [
    "Alignment",
    "Calibration",
    "Capture",
    "CombinedSetup",
    "Correspondence",
    "Display",
    "Fit",
    "FolderRig",
    "GPhoto2Camera",
    "LiveRig",
    "MitsubaRig",
    "OpenCVCamera",
    "PhotographOrder",
    "Project",
    "Report",
    "Rig",
    "ScanSettings",
    "Setup",
    "Shots",
    "Update",
    "VirtualRig",
    "acquire",
    "align",
    "camera_map",
    "combine_scans",
    "finalize",
    "fit",
    "import_gray_code",
    "update",
]
