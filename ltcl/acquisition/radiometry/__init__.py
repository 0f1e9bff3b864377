# SPDX-License-Identifier: BSD-3-Clause
"""Light from the codes of a camera, and codes for the light of a projector.

    stack           photographs of one scene at several exposures, checked
    response        Response: from codes to linear light
    curve           monotone splines, and least squares over them
    calibration     calibrate: the response from photographs alone
    consistency     how far photographs, seconds and response agree
    noise           NoiseModel; estimate: from repeated photographs
    merge           merge: photographs to Radiance, with its variance and what of it is valid
    exposures       choose: which ones to take; bracket: which ones to calibrate from
    black           the camera's offset and the ambient light
    projector       ProjectorResponse: from codes to the projector's light
    colour          mixing of the projector's colours in the camera's; unmix

A linear value is light on the sensor, 1 at the largest code; radiance is linear value per second.
"""

from __future__ import annotations

from ltcl.acquisition.radiometry import black, colour, projector
from ltcl.acquisition.radiometry.black import Black
from ltcl.acquisition.radiometry.calibration import calibrate
from ltcl.acquisition.radiometry.colour import mixing, unmix
from ltcl.acquisition.radiometry.consistency import consistency
from ltcl.acquisition.radiometry.exposures import bracket, choose
from ltcl.acquisition.radiometry.merge import Radiance, merge
from ltcl.acquisition.radiometry.noise import NoiseModel, estimate
from ltcl.acquisition.radiometry.projector import ProjectorResponse
from ltcl.acquisition.radiometry.response import Response

__all__ = [
    "Black",
    "NoiseModel",
    "ProjectorResponse",
    "Radiance",
    "Response",
    "black",
    "bracket",
    "calibrate",
    "choose",
    "colour",
    "consistency",
    "estimate",
    "merge",
    "mixing",
    "projector",
    "unmix",
]
