# SPDX-License-Identifier: BSD-3-Clause
"""Opaque blocks that stand in a room along its axes, cast shadows and hide what is behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.walls import Vector, Wall, check_albedo, vector

_DIRECTIONS = {"+x": (0, 1), "-x": (0, -1), "+y": (1, 1), "-y": (1, -1), "top": (2, 1), "bottom": (2, -1)}


@dataclass(frozen=True)
class Block:
    """A box with sides along the axes.

    Parameters
    ----------
    corner, size : (3,) floats
        Its corner nearest to the origin, and its lengths along x, y and z.
    albedo : float or (3,) floats, optional
        Of all its faces, one number or one colour: they become walls of the picture then, lit and seen.
        Without it the block is black: it shades and hides.

    Raises
    ------
    InputError
        If a number is not finite, a length is not above 0, or the albedo is outside [0, 1).

    Examples
    --------
    >>> block = Block(corner=(0.3, 0.4, 0), size=(0.2, 0.2, 0.5), albedo=0.6)
    >>> [wall.name for wall in block.faces()]
    ['block +x', 'block -x', 'block +y', 'block -y', 'block top', 'block bottom']
    """

    corner: Vector
    size: Vector
    albedo: Any = None

    def __post_init__(self) -> None:
        for name in ("corner", "size"):
            object.__setattr__(self, name, point(f"block {name}", getattr(self, name)))
        if min(self.size) <= 0:
            raise InputError(f"block size is {self.size}; all three lengths must be above 0")
        if self.albedo is not None:
            value = checks.finite("block albedo", checks.real("block albedo", self.albedo))
            check_albedo(checks.shape("block albedo", value.astype(np.float64), (), (3,)))

    @property
    def low(self) -> np.ndarray:
        """The corner nearest to the origin, (3,)."""
        return np.array(self.corner)

    @property
    def high(self) -> np.ndarray:
        """The corner opposite to it, (3,)."""
        return np.add(self.corner, self.size)

    def faces(self) -> tuple[Wall, ...]:
        """Its six faces as walls that look outwards; side faces stand upright."""
        return tuple(self._face(name, *direction) for name, direction in _DIRECTIONS.items())

    def covers(self, points: np.ndarray) -> np.ndarray:
        """Which of some points (..., 3) lie inside it, (...) bool."""
        return np.all((points > self.low) & (points < self.high), axis=-1)

    def _face(self, name: str, axis: int, sign: int) -> Wall:
        normal = np.zeros(3)
        normal[axis] = sign
        # Side faces hang from their upper edge; top and bottom lie as floor and ceiling do.
        down = (
            np.array([0.0, 0.0, -1.0])
            if axis < 2
            else np.array([1.0, 0, 0])
            if sign > 0
            else np.array([0, 1.0, 0])
        )
        right = np.cross(normal, down)
        right, down = right * self.size, down * self.size
        middle = (self.low + self.high + normal * self.size) / 2
        return Wall(f"block {name}", *(vector(v) for v in (middle - right / 2 - down / 2, right, down)))


def point(name: str, value: Any) -> Vector:
    """Return `value` as three finite floats.

    Raises
    ------
    InputError
        If it is anything else.

    Examples
    --------
    >>> point("light", [1, 2, 3])
    (1.0, 2.0, 3.0)
    """
    try:
        array = checks.real(name, value)
    except InputTypeError as error:
        raise InputTypeError(f"{name} is {value!r}; it must be three numbers (x, y, z)") from error
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(f"{name} is {value!r}; it must be three finite numbers (x, y, z)")
    return vector(array)
