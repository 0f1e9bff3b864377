# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a transport: what drives projectors and cameras, and what their pictures say.

    rig         Rig, what a set-up of projector and camera must offer; Shots, which checks and counts
    rigs/       set-ups: virtual (over a known T), Mitsuba (rendered), folder (photographs taken by a person),
                live (a camera on a cable and a second display)
    radiometry/ light from codes: response, noise, exposures, black, merging, colours
    geometry/   which projector pixel a camera pixel sees: Gray code, phase shift, resampling
    calibration, measuring, ramps, taking, exposing, agreeing, stuck    all that is measured once of a set-up:
                for how many seconds, from photographs that do not contradict each other
    scanning/   which pixels are lit when, and T from the pictures; plan before, report after
    task, run   acquire: all of it, into a store, stopped and resumed; kept: photographs of a calibration
    settings    what acquire is asked for, checked
    forecasting how far pictures and bounces are off by the noise of the scan
    finishing   finalize: the transport of a store whose photographs are all there
    setup       Setup: codes for a pattern, and the ambient light, on the pixels of a transport
    held        how far a transport is from a scene that is known
    project     Project: an acquisition as a folder with an acquisition.toml; project_rigs makes its rig

Codes in [0, 1] are what a projector is fed and what a camera gives; they are not linear in light.
"""

from __future__ import annotations

from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.finishing import finalize
from ltcl.acquisition.forecasting import Forecast, forecast_bounces, forecast_picture
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
