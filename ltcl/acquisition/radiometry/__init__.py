# SPDX-License-Identifier: BSD-3-Clause
"""Light from the codes of a camera, and codes for the light of a projector.

    stack        photographs of one scene at several exposures, checked
    response     Response: from codes to linear light; calibrate: the response from photographs alone
    noise        NoiseModel; estimate: from repeated photographs
    merge        merge: photographs to Radiance, with its variance and what of it is valid
    black        the camera's offset and the ambient light
    projector    ProjectorResponse: from codes to the projector's light
    colour       mixing of the projector's colours in the camera's

A linear value is light on the sensor, 1 at the largest code; radiance is linear value per second.
"""

from __future__ import annotations

from ltcl.acquisition.radiometry import black, projector
from ltcl.acquisition.radiometry.black import Black
from ltcl.acquisition.radiometry.colour import mixing
from ltcl.acquisition.radiometry.merge import Radiance, merge
from ltcl.acquisition.radiometry.noise import NoiseModel, estimate
from ltcl.acquisition.radiometry.projector import ProjectorResponse
from ltcl.acquisition.radiometry.response import Response, calibrate

__all__ = [
    "Black",
    "NoiseModel",
    "ProjectorResponse",
    "Radiance",
    "Response",
    "black",
    "calibrate",
    "estimate",
    "merge",
    "mixing",
    "projector",
]
