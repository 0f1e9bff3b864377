# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a transport: what drives projectors and cameras, and what their pictures say.

    task        acquire: all of it, into a store, stopped and resumed
    rig         Rig, what a set-up of projector and camera must offer; Shots, which checks and counts
    rigs/       set-ups: virtual (over a known T), Mitsuba (rendered), folder (photographs taken by a person),
                live (a camera on a cable and a second display)
    radiometry/ light from codes: response, noise, black, merging, colours
    geometry/   which projector pixel a camera pixel sees: Gray code, resampling
    exposure, calibrate, calibration    all that is measured once of a set-up, and its record
    agreement, anchor    the one check: photographs that deviate from what others show are refused by number
    session, kept        photographs as they are taken; those of a calibration, until it has ended
    scanning/   which pixels are lit when, and T from the pictures; plan before, report and forecast after
    settings    the arguments of acquire, checked
    setup       Setup: codes for a pattern, and the ambient light, on the pixels of a transport
    project     Project: an acquisition as a folder with an acquisition.toml, and its rig

Codes in [0, 1] are what a projector is fed and what a camera gives; they are not linear in light.
"""

from __future__ import annotations

from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.finishing import finalize
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
    mitsuba_scene,
)
from ltcl.acquisition.scanning.forecast import Forecast, forecast_bounces, forecast_picture
from ltcl.acquisition.scanning.report import Report
from ltcl.acquisition.setup import Setup
from ltcl.acquisition.task import acquire

__all__ = [
    "Calibration",
    "Correspondence",
    "Display",
    "FolderRig",
    "Forecast",
    "GPhoto2Camera",
    "LiveRig",
    "MitsubaRig",
    "OpenCVCamera",
    "Project",
    "Report",
    "Rig",
    "Setup",
    "Shots",
    "VirtualRig",
    "acquire",
    "camera_map",
    "finalize",
    "forecast_bounces",
    "forecast_picture",
    "mitsuba_scene",
]
