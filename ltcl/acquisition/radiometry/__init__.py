# SPDX-License-Identifier: BSD-3-Clause
"""Light from the codes of a camera, and codes for the light of a projector.

    exposures       photographs at several exposures, checked
    response        from codes to linear light
    response_fit    the response, estimated from photographs alone
    noise           noise and black level of a camera, estimated from photographs
    merge           photographs to radiance, with its variance and its valid pixels
    strips          work on a picture in strips of rows, in parallel
    projector       from codes to the light of the projector, and how its colours mix

A linear value is light on the sensor, 1 at the largest code; radiance is linear value per second.
"""

from __future__ import annotations

from ltcl.acquisition.radiometry.merge import Radiance, merge
from ltcl.acquisition.radiometry.noise import NoiseModel, black_level, estimate
from ltcl.acquisition.radiometry.projector import colour_response, mixing, projector_response
from ltcl.acquisition.radiometry.response import Response
from ltcl.acquisition.radiometry.response_fit import calibrate

__all__ = ["NoiseModel", "Radiance", "Response"]
__all__ += ["black_level", "calibrate", "colour_response", "estimate", "merge", "mixing"]
__all__ += ["projector_response"]
