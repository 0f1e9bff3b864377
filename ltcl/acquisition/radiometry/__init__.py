# SPDX-License-Identifier: BSD-3-Clause
"""Light from the codes of a camera, and codes for the light of a projector.

    response     from codes to linear light, and its estimation from photographs alone
    camera       photographs at several exposures; noise, from repeated ones; the level of black
    merge        photographs to radiance, with its variance and what of it is valid
    projector    from codes to the light of the projector, and how its colours mix

A linear value is light on the sensor, 1 at the largest code; radiance is linear value per second.
"""

from __future__ import annotations

from ltcl.acquisition.radiometry.camera import NoiseModel, black_level, estimate
from ltcl.acquisition.radiometry.merge import Radiance, merge
from ltcl.acquisition.radiometry.projector import mixing, projector_response
from ltcl.acquisition.radiometry.response import Response, calibrate

__all__ = ["NoiseModel", "Radiance", "Response"]
__all__ += ["black_level", "calibrate", "estimate", "merge", "mixing", "projector_response"]
