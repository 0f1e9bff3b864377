# SPDX-License-Identifier: BSD-3-Clause
"""Refusal of walls that cut through each other or cover each other: light cannot tell which side it is on.

Walls may touch: along an edge, at a corner, or one with its edge in the middle of the other.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ltcl.errors import InputError
from ltcl.scenes.walls import Wall

_TOUCH = 1e-9  # of the larger wall: overlaps that are rounding errors


def refuse(walls: Sequence[Wall]) -> None:
    """Refuse walls of which two cut through each other, or lie on top of each other facing the same way.

    Raises
    ------
    InputError
        With the names of the first two that do.

    Examples
    --------
    >>> floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    >>> screen = Wall("screen", corner=(0.5, 0, 1), right=(0, 1, 0), down=(0, 0, -2))
    >>> refuse([floor, screen])
    Traceback (most recent call last):
    ltcl.errors.InputError: walls 'floor' and 'screen' cut through each other; move or shorten one
    """
    for first, second in itertools.combinations(walls, 2):
        what = _overlap(_corners(first), _corners(second), same=bool(first.normal @ second.normal > 0))
        if what:
            raise InputError(f"walls {first.name!r} and {second.name!r} {what}; move or shorten one")


def _corners(wall: Wall) -> np.ndarray:
    """(4, 3), around."""
    corner, right, down = (np.asarray(v, np.float64) for v in (wall.corner, wall.right, wall.down))
    return np.stack([corner, corner + down, corner + down + right, corner + right])


def _overlap(first: np.ndarray, second: np.ndarray, same: bool) -> str:
    touch = _TOUCH * max(np.abs(np.diff(corners, axis=0)).max() for corners in (first, second))
    over, under = _heights(first, second), _heights(second, first)
    if same and max(np.abs(over).max(), np.abs(under).max()) <= touch:
        return "lie on top of each other" if cover(first, second, touch) else ""
    if min(-over.min(), over.max(), -under.min(), under.max()) <= touch:
        return ""
    # Both planes are cut. On their common line each wall fills an interval.
    line = np.cross(_normal(first), _normal(second))
    line /= np.linalg.norm(line)
    (low, high), (other_low, other_high) = _span(first, under, line), _span(second, over, line)
    return "cut through each other" if min(high, other_high) - max(low, other_low) > touch else ""


def _normal(corners: np.ndarray) -> np.ndarray:
    normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
    return normal / np.linalg.norm(normal)


def _heights(plane: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Signed distances (4,) of one wall's corners from the other's plane."""
    return (corners - plane[0]) @ _normal(plane)


def _span(corners: np.ndarray, height: np.ndarray, line: np.ndarray) -> tuple[float, float]:
    """Where a wall meets a plane that cuts it: from and to along the line."""
    after, height_after = np.roll(corners, -1, axis=0), np.roll(height, -1)
    crossing = (height < 0) != (height_after < 0)
    share = height[crossing] / (height[crossing] - height_after[crossing])
    along = (corners[crossing] + share[:, None] * (after - corners)[crossing]) @ line
    return float(along.min()), float(along.max())


def cover(first: np.ndarray, second: np.ndarray, touch: float) -> bool:
    """Whether convex outlines (4, 3) in one plane overlap: no line along an edge of one parts them."""
    normal = _normal(first)
    for corners in (first, second):
        for edge in np.roll(corners, -1, axis=0) - corners:
            across = np.cross(normal, edge) / np.linalg.norm(edge)
            one, other = first @ across, second @ across
            if min(one.max(), other.max()) - max(one.min(), other.min()) <= touch:
                return False
    return True
