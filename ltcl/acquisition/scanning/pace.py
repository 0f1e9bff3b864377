# SPDX-License-Identifier: BSD-3-Clause
"""Pace of this machine: seconds of computing for a photograph, by the megapixels of the camera.

What every photograph of a scan goes through is done with a small picture: it is written to a file,
merged to radiance with its exposures, and read back by channels. Known limit: files that the system
keeps in memory are faster than those of a scan that does not fit there.
"""

from __future__ import annotations

import math
import time

import numpy as np

from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.radiance import planes
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.scratch import ImageFile
from ltcl.acquisition.session import Photograph, merge_photographs

# Pixels of the picture along each side, and its exposures.
SIDE = 512
EXPOSURES = (0.5, 1.0)
# The first time is longer, and others use the machine, too: the least counts.
REPEATS = 3


class _Camera:
    """A camera of 8 bits."""

    def __init__(self, channels: int) -> None:
        self.channels = channels


def seconds_per_megapixel(channels: int = 1) -> float:
    """Seconds of computing for each photograph and megapixel, measured in a few tenths of one.

    Parameters
    ----------
    channels : int
        1 or 3, of the camera.

    Examples
    --------
    >>> 0.0 < seconds_per_megapixel() < 10.0
    True
    """
    shape = (SIDE, SIDE) if channels == 1 else (SIDE, SIDE, channels)
    ramp = np.linspace(10.0, 200.0, math.prod(shape)).reshape(shape)
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        file = ImageFile()
        photographs = []
        for number, seconds in enumerate(EXPOSURES):
            image = (seconds * ramp).astype(np.uint8)
            photographs.append(
                Photograph(
                    stored=file.append(image),
                    rig=_Camera(channels),
                    seconds=seconds,
                    number=number,
                )
            )
        camera = CameraModel(response=Response.identity())
        light = merge_photographs(photographs, camera, 256, file)
        for name in ("value", "variance"):
            for plane in planes(light, name):
                plane.sum()
        times.append(time.perf_counter() - start)
    megapixels = SIDE * SIDE / 1e6
    return min(times) / (len(EXPOSURES) * megapixels)
