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

from ltcl.transport.noise.blocks import MIN_VARIANCE, Blocks, detail_variance
from ltcl.transport.noise.windows import Windows

# Gain from which on errors are shared.
MIN_GAIN = 1.4
# Power of the gain without the mean of a window, at most, that errors shared by few pixels have
# with it; texture has far more.
MAX_POWER = 6
# Flatness up to which the finest detail is noise.
MAX_FLATNESS = 1.4


@dataclass(frozen=True, kw_only=True)
class Correlation:
    """Factors of the variance by errors that pixels of a picture share; NaN if light hides them."""

    camera: float = np.nan
    projector: float = np.nan

    @property
    def factor(self) -> float:
        """Factor of the variance, 1 if it is not known."""
        if np.isfinite(self.camera):
            return self.camera
        return 1.0

    @property
    def is_white(self) -> bool:
        """True if errors are independent for certain."""
        return self.camera == self.projector == 1.0


def find_correlation(blocks: Blocks, is_noise: np.ndarray) -> Correlation:
    """Compare details along one picture and along both, of the blocks that are noise."""
    X = blocks.entries
    return Correlation(
        camera=_gain(X, blocks.projector, blocks.camera, is_noise),
        projector=_gain(X.transpose(2, 3, 0, 1), blocks.camera, blocks.projector, is_noise.T),
    )


def _gain(X: np.ndarray, projector: Windows, camera: Windows, is_noise: np.ndarray) -> float:
    """Variance of fine detail along the projector, over that of detail along the camera, too."""
    if camera.order < 2 or not is_noise.any():
        return np.nan

    def typical(camera: Windows | None, projector: Windows) -> float:
        return float(np.median(detail_variance(X, camera, projector)[is_noise]))

    finest = projector.finest()
    independent = typical(camera, finest)
    # Texture is the same for all pixels of a window, and has no detail even of the first degree.
    gain_of_gradients = typical(camera.with_order(1), finest) / max(independent, MIN_VARIANCE)
    if gain_of_gradients < MIN_GAIN:
        return 1.0
    shared = typical(None, finest)
    if shared > gain_of_gradients**MAX_POWER * independent:
        return 1.0
    if typical(None, projector) > MAX_FLATNESS * shared:
        return np.nan
    return shared / max(independent, MIN_VARIANCE)
