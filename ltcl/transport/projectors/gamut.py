# SPDX-License-Identifier: BSD-3-Clause
"""Colours that every projector reaches everywhere, and how far the projectors differ.

G_k = diag(f_k) M_k has the primaries of projector k in its columns, as the camera sees them: f_k is
the direct light of white in each channel where it is dim, M_k the mixing of its colours. With the
mean primaries P and their white w = P 1, the primaries (1 - t) P + t w 1^T / 3 move towards white
until all projectors reach them with light of at least 0, and are dimmed until all reach their sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError

# Share of the camera pixels of a projector, away from its rim, that may be dimmer than what counts
# as reached.
DIM_QUANTILE = 0.05
# Light below 0 that rounding explains, in units of white.
SLACK = 1e-9
STEPS = 256


@dataclass(frozen=True, kw_only=True, eq=False)
class Gamut:
    """The colours that all projectors have in common.

    Attributes
    ----------
    primaries : (channels, channels)
        Columns are the light of red, green and blue, in the units of T.
    white : (channels,)
        Their sum.
    desaturation : float
        How far the primaries are moved towards white, from 0 to 1.
    projectors : (projectors, channels, channels)
        The primaries of each projector.
    differences : (projectors,)
        Norm of the deviation of each projector's primaries from the mean, over that of the mean.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.Transport(numpy.eye(4), grid=(2, 2), camera_grid=(2, 2))
    >>> dim = ltcl.Transport(0.5 * numpy.eye(4), grid=(2, 2), camera_grid=(2, 2))
    >>> ltcl.combine([T, dim]).gamut.white.tolist()
    [0.5]
    """

    primaries: np.ndarray
    white: np.ndarray
    desaturation: float
    projectors: np.ndarray
    differences: np.ndarray

    def light(self, picture: Any) -> np.ndarray:
        """The picture (..., 3) or, in grey, (...) of values from 0 to 1 as light of this gamut."""
        values = checks.real("picture", picture)
        if len(self.white) == 1:
            return values * self.white[0]
        if values.shape[-1:] != (3,):
            raise InputError(f"picture has shape {values.shape}; it must be (h, w, 3)")
        return values @ self.primaries.T

    def __str__(self) -> str:
        deviations = []
        for number, difference in enumerate(self.differences, start=1):
            deviations.append(f"projector {number} by {difference:.1%}")
        return (
            f"projectors differ from their mean: {', '.join(deviations)}; "
            f"common primaries are moved {self.desaturation:.1%} towards white"
        )


def common_gamut(whites: Sequence[np.ndarray], mixings: Sequence[np.ndarray]) -> Gamut:
    """The gamut of projectors with direct light (channels, M) of white, and their mixings."""
    primaries = []
    for white, mixing in zip(whites, mixings, strict=True):
        is_lit = (white > 0.0).all(axis=0)
        reached = np.zeros(len(white))
        if is_lit.any():
            reached = np.quantile(white[:, is_lit], DIM_QUANTILE, axis=1)
        primaries.append(reached[:, None] * mixing)
    projectors = np.stack(primaries)
    mean = projectors.mean(axis=0)
    inverses = np.linalg.pinv(projectors)
    size = float(np.linalg.norm(mean))
    deviations = np.linalg.norm(projectors - mean, axis=(1, 2))
    desaturation = _least_desaturation(mean, inverses)
    moved = _desaturated(mean, desaturation)
    needed = float(np.max((inverses @ moved).sum(axis=2)))
    common = moved / needed if needed > 0.0 else moved
    return Gamut(
        primaries=common,
        white=common.sum(axis=1),
        desaturation=desaturation,
        projectors=projectors,
        differences=deviations / size if size > 0.0 else deviations,
    )


def _desaturated(primaries: np.ndarray, share: float) -> np.ndarray:
    channels = len(primaries)
    white = primaries.sum(axis=1, keepdims=True) / channels
    return (1.0 - share) * primaries + share * white


def _least_desaturation(mean: np.ndarray, inverses: np.ndarray) -> float:
    """The least share of white with which all projectors reach the mean primaries."""
    for share in np.linspace(0.0, 1.0, STEPS + 1):
        light = inverses @ _desaturated(mean, float(share))
        if light.min() >= -SLACK:
            return float(share)
    return 1.0
