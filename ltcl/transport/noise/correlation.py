# SPDX-License-Identifier: BSD-3-Clause
"""Errors that neighbouring pixels share, as those of demosaiced or resized photographs.

Detail along the axes of the camera misses a part of them. Detail along those of the projector alone
does not, but sees light that is not smooth: light has less detail of a higher degree, errors that
are independent from column to column have as much. So the variance is multiplied by

    gain = detail along the projector / detail along both

if `flatness`, detail along the projector / its part of the highest degrees, is about 1. The same
holds for errors that neighbouring columns share, with the axes exchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.transport.noise.blocks import Blocks, detail_variance

# Gain from which on errors are shared.
MIN_GAIN = 1.4
# Flatness up to which the finest detail is noise.
MAX_FLATNESS = 1.4


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Factors of the variance by errors that pixels share; NaN if light hides them."""

    camera: float
    projector: float

    @property
    def factor(self) -> float:
        """Factor of the variance, 1 if it is not known."""
        factors = np.array([self.camera, self.projector])
        return float(np.prod(factors[np.isfinite(factors)]))

    @property
    def is_white(self) -> bool:
        """True if errors are independent for certain."""
        return self.camera == self.projector == 1.0


def find_correlation(blocks: Blocks, is_noise: np.ndarray) -> Correlation:
    """Compare details along one picture and along both, of the blocks that are noise."""
    X = blocks.entries
    fine_camera = blocks.camera.finest()
    fine_projector = blocks.projector.finest()
    along_projector = detail_variance(X, None, fine_projector)
    along_camera = detail_variance(X, fine_camera, None)
    return Correlation(
        camera=_gain(
            along_projector[is_noise],
            both=detail_variance(X, blocks.camera, fine_projector)[is_noise],
            coarse=detail_variance(X, None, blocks.projector)[is_noise],
        ),
        projector=_gain(
            along_camera[is_noise],
            both=detail_variance(X, fine_camera, blocks.projector)[is_noise],
            coarse=detail_variance(X, blocks.camera, None)[is_noise],
        ),
    )


def _gain(fine: np.ndarray, both: np.ndarray, coarse: np.ndarray) -> float:
    """Factor of the variance by `fine` detail along one picture, over that along both."""
    is_known = (fine > 0.0) & (both > 0.0)
    if not is_known.any():
        return float("nan")
    gain = float(np.median(fine[is_known] / both[is_known]))
    if gain < MIN_GAIN:
        return 1.0
    flatness = np.median(coarse[is_known] / fine[is_known])
    if flatness > MAX_FLATNESS:
        return float("nan")
    return gain
