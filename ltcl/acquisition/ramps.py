# SPDX-License-Identifier: BSD-3-Clause
"""The response of a camera, from ramps beside black at a bracket of exposures.

Known limit: the unit of light is what the response reaches at the last code, for which nothing else stands.
A colour that the wall hardly reflects is photographed for longer, up to 16 times, so that its curve reaches
that code too: one that ends before has a unit of its own, and grey is no longer grey.
"""

from __future__ import annotations

import numpy as np

from ltcl.acquisition import agreeing, exposing
from ltcl.acquisition.radiometry import Response, bracket, calibrate
from ltcl.acquisition.stuck import healed, stuck
from ltcl.acquisition.taking import Taking
from ltcl.errors import InputError

TOP = 0.995  # of the codes: the unit of a curve is what it reaches at the last one
_BRACKET, _SPAN = 8, 16.0  # exposures to find the response from, and how far from that of white
_LONGER, _STEP = 4, 2.0  # more of them at most, where a colour stays dark; times the one before
_DARKER = 0.99  # share of the pixels: the others must reach the last code in each colour
_RAMPS, _MANY, _FEW = 4, 4096, 64  # scenes of them where there are fewer pixels; for so many pixels at least


def response_of(run: Taking, seconds: float) -> Response:
    """The response of the camera, with exposures about that which is bright enough for white.

    Raises
    ------
    InputError
        The camera has one exposure only.
    AcquisitionError
        The photographs tell no response, or contradict each other.
    """
    span = bracket(seconds / _SPAN, seconds * _SPAN, _BRACKET)
    times, grid = exposing.offered(run.shots, span), run.shots.grid
    if len(times) == 1:
        raise InputError(exposing.ONE)
    lit = [*_ramps(grid), run.black]
    taken = run.take([(codes, t) for t in times for codes in lit])
    bad = stuck(taken[len(lit) - 1])  # under black, for the shortest time
    longest = exposing.offered(run.shots, [times[-1] * _STEP**k for k in range(1, _LONGER + 1)])
    for longer in (t for t in longest if t > times[-1]):
        if _reached(_beside(taken[-len(lit) :], bad)):
            break
        taken, times = [*taken, *run.take([(codes, longer) for codes in lit])], (*times, longer)
    every = [_beside(taken[k : k + len(lit)], bad) for k in range(0, len(taken), len(lit))]
    numbers = range(run.shots.number + 1 - len(taken), run.shots.number + 1)
    with exposing.telling(f"the response of the camera, photographs {numbers[0]} to {numbers[-1]}"):
        found = calibrate(every, times, levels=run.shots.levels, saturation=TOP)
    for k in range(len(lit)):
        scene = slice(k, None, len(lit))
        agreeing.refuse_unlike(taken[scene], times, numbers[scene], found)
    return found


def ramp(grid: tuple[int, int], shift: int = 0) -> np.ndarray:
    """Codes from 0 to 1 along the longer side, some pixels further: all brightnesses in one picture."""
    h, w = grid
    long = np.roll(np.linspace(0.0, 1.0, max(h, w), dtype=np.float32), shift)
    return np.ascontiguousarray(np.broadcast_to(long if w >= h else long[:, None], grid))


def _ramps(grid: tuple[int, int]) -> list[np.ndarray]:
    """As many as it takes for some hundred pixels; in further rounds with other brightnesses."""
    pixels = grid[0] * grid[1]
    count = 1 if pixels >= _MANY else max(_RAMPS, -(-_FEW // pixels))
    rounds = -(-count // _RAMPS)
    return [
        ramp(grid, k % _RAMPS * max(grid) // _RAMPS) * np.float32(1.0 - k // _RAMPS / (2.0 * rounds))
        for k in range(count)
    ]


def _beside(images: list[np.ndarray], bad: np.ndarray) -> np.ndarray:
    """Photographs side by side, without the pixels that are stuck."""
    return np.hstack([healed(image, bad) for image in images])


def _reached(image: np.ndarray) -> bool:
    """Whether each colour has light at its last code; of one channel, no other's unit must be the same."""
    return image.ndim == 2 or bool(np.quantile(image, _DARKER, axis=(0, 1)).min() >= TOP)
