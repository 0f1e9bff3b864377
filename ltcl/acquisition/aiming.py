# SPDX-License-Identifier: BSD-3-Clause
"""Aiming: brightness, focus and coverage of the lit area, before a scan.

A rig is asked for white, black, and stripes of two projector pixels with their inverse. A pixel is
lit if white less black reaches a tenth of the brightest. The focus is the contrast of the stripes,

    |p - q| / (w - b),    p, q: stripes and inverse; w, b: white and black,

at the upper quartile of lit pixels, as those on an edge have none: 1 if camera and projector are
sharp. A single photograph, of white, tells its lit area by Otsu's threshold, and of the focus only
how much brighter and darker neighbouring pixels are, which is largest where it is sharpest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ltcl.acquisition.metering import (
    BRIGHT_QUANTILE,
    FIRST_EXPOSURE,
    MAX_WHITE_CODE,
    MIN_WHITE_CODE,
    SATURATED_CODE,
    exposure_factor,
)
from ltcl.acquisition.rig import Shots, nearest

# Of the brightest difference of white and black: what is lit.
LIT_SHARE = 0.1
# Quantile of the contrasts of lit pixels.
FOCUS_QUANTILE = 0.75
# Projector pixels of a stripe.
STRIPE = 2
# Contrast below which the focus is told.
MIN_FOCUS = 0.5
# Share of a side of the photograph that the lit area may touch.
MAX_BORDER_SHARE = 0.02
# Share of the photograph that should be lit.
MIN_LIT_SHARE = 0.1
MAX_SATURATED_SHARE = 0.001


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading:
    """The camera's view of the projector, in figures.

    Attributes
    ----------
    seconds : float or None
        Exposure; None if it is not known.
    brightness : float
        Code of the brightest pixels of the lit area under white, in [0, 1], but a thousandth.
    saturated : float
        Share of the lit area that is saturated.
    lit : float
        Share of the photograph that the projector lights.
    sides : tuple of str
        Sides of the photograph that the lit area reaches: "left", "right", "top", "bottom".
    focus : float or None
        Contrast of fine stripes; None of a single photograph.
    sharpness : float
        Mean difference of a lit pixel from its neighbours, relative to their light.
    picture : ndarray
        The photograph of white, in [0, 1].
    """

    seconds: float | None
    brightness: float
    saturated: float
    lit: float
    sides: tuple[str, ...]
    focus: float | None
    sharpness: float
    picture: np.ndarray

    @property
    def advice(self) -> list[str]:
        """Advice on what should be better, each in a line."""
        lines = []
        if self.saturated > MAX_SATURATED_SHARE:
            lines.append(f"{self.saturated:.1%} of the lit area are saturated: expose shorter")
        elif self.brightness < MIN_WHITE_CODE:
            lines.append(f"white reaches {self.brightness:.0%} of full scale: expose longer")
        if self.sides:
            sides = " and ".join(self.sides)
            lines.append(f"the lit area reaches the {sides} of the photograph: turn the camera")
        if self.lit < MIN_LIT_SHARE:
            lines.append(f"{self.lit:.1%} of the photograph are lit: move or zoom nearer")
        if self.focus is not None and self.focus < MIN_FOCUS:
            lines.append(
                f"stripes of {STRIPE} pixels have a contrast of {self.focus:.0%}: focus projector "
                "and camera"
            )
        return lines

    @property
    def facts(self) -> list[str]:
        """The numbers, each in a few words."""
        facts = [
            f"brightness {self.brightness:.0%}",
            f"lit {self.lit:.0%} of the photograph",
            f"saturated {self.saturated:.1%}",
        ]
        if self.focus is None:
            facts.append(f"sharpness {self.sharpness:.3f}")
        else:
            facts.append(f"focus {self.focus:.0%}")
        if self.seconds is not None:
            facts.append(f"{self.seconds:.3g} s")
        return facts


class Aim:
    """Readings of a rig, one after the other; the exposure follows the brightness.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> rig = VirtualRig(np.eye(64 * 64) / 2, (64, 64))
    >>> aim = Aim(rig)
    >>> readings = [aim.look() for _ in range(4)]
    >>> 0.3 < readings[-1].brightness < 0.95, readings[-1].focus > 0.9
    (True, True)
    """

    def __init__(self, rig: Any) -> None:
        self._shots = Shots(rig)
        self._seconds = nearest(self._shots.exposures, FIRST_EXPOSURE)

    def look(self) -> Reading:
        """Take four photographs, and tell what they show."""
        grid = self._shots.grid
        column = np.arange(grid[1])
        stripes = np.broadcast_to(column // STRIPE % 2 == 0, grid).astype(np.float32)
        patterns = [np.ones(grid, np.float32), np.zeros(grid, np.float32), stripes, 1.0 - stripes]
        seconds = self._seconds
        photographs = [self._shots.photograph(pattern, seconds) for pattern in patterns]
        reading = read_patterns(photographs, seconds)
        if not MIN_WHITE_CODE <= reading.brightness <= MAX_WHITE_CODE:
            better_exposure = seconds * exposure_factor(reading.brightness)
            self._seconds = nearest(self._shots.exposures, better_exposure)
        return reading


def read_patterns(photographs: Sequence[np.ndarray], seconds: float | None = None) -> Reading:
    """Read photographs of white, black, fine stripes and their inverse, in [0, 1]."""
    white, black, stripes, inverse = (_grey(image) for image in photographs)
    light = white - black
    brightest = max(float(np.quantile(light, BRIGHT_QUANTILE)), 1e-6)
    is_lit = light > LIT_SHARE * brightest
    contrast = np.abs(stripes - inverse)[is_lit] / light[is_lit]
    focus = float(np.quantile(contrast, FOCUS_QUANTILE)) if is_lit.any() else 0.0
    return _reading(photographs[0], is_lit, seconds, min(focus, 1.0))


def read_white(photograph: np.ndarray, seconds: float | None = None) -> Reading:
    """Read one photograph of white, in [0, 1]."""
    codes = np.rint(255 * np.clip(_grey(photograph), 0.0, 1.0)).astype(np.uint8)
    threshold, _ = cv2.threshold(codes, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return _reading(photograph, codes > threshold, seconds, None)


def _reading(
    white: np.ndarray, is_lit: np.ndarray, seconds: float | None, focus: float | None
) -> Reading:
    grey = _grey(white)
    full = white if white.ndim == 2 else white.max(axis=-1)
    brightness = 0.0
    saturated = 0.0
    sharpness = 0.0
    if is_lit.any():
        brightness = float(np.quantile(full[is_lit], BRIGHT_QUANTILE))
        saturated = float(np.mean(full[is_lit] >= SATURATED_CODE))
        difference = np.abs(cv2.Laplacian(grey, cv2.CV_32F))
        # Not on the border of the lit area, which is sharp in any case.
        inner = cv2.erode(is_lit.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
        if inner.any():
            sharpness = float(difference[inner].mean() / max(grey[inner].mean(), 1e-6))
    return Reading(
        seconds=seconds,
        brightness=brightness,
        saturated=saturated,
        lit=float(is_lit.mean()),
        sides=_sides(is_lit),
        focus=focus,
        sharpness=sharpness,
        picture=white,
    )


def _sides(is_lit: np.ndarray) -> tuple[str, ...]:
    """The sides of a photograph that the lit area reaches."""
    borders = {
        "left": is_lit[:, 0],
        "right": is_lit[:, -1],
        "top": is_lit[0],
        "bottom": is_lit[-1],
    }
    return tuple(name for name, border in borders.items() if border.mean() > MAX_BORDER_SHARE)


def _grey(image: np.ndarray) -> np.ndarray:
    grey = image if image.ndim == 2 else image.mean(axis=-1)
    return np.ascontiguousarray(grey, np.float32)
