# SPDX-License-Identifier: BSD-3-Clause
"""Corners and a room for Mitsuba 3 (extra `rig`), with a projector and a camera that look at them.

The viewer is on the z axis and looks towards -z, y is up. Walls are diffuse unit squares:

    dihedral    two that meet in an upright edge at z = 0
    trihedral   three that meet in the origin, the corner of a cube seen along its diagonal
    box         five, the inside of a cube from its open front: back, left, right, floor, ceiling

Projector and camera are pinholes whose frames hold all the walls, so that no surface reflects which the
projector does not light: what T knows is then all there is. What lies beside the walls is black.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rigs import extras
from ltcl.errors import InputError

_HALF, _THIRD = math.sqrt(1 / 2), math.sqrt(1 / 3)
_AXES = [
    np.array([math.sqrt(2 / 3) * math.cos(turn), math.sqrt(2 / 3) * math.sin(turn), _THIRD])
    for turn in (math.pi / 2, math.pi * 7 / 6, math.pi * 11 / 6)
]
_Wall = tuple[Any, Any, Any]  # corner (3,), and both edges from it; right x up faces the viewer's side

_DIHEDRAL: tuple[_Wall, ...] = (
    ((-_HALF, -0.5, _HALF), (_HALF, 0, -_HALF), (0, 1, 0)),
    ((0, -0.5, 0), (_HALF, 0, _HALF), (0, 1, 0)),
)
_TRIHEDRAL: tuple[_Wall, ...] = tuple(((0, 0, 0), _AXES[k], _AXES[(k + 1) % 3]) for k in range(3))
_BOX: tuple[_Wall, ...] = (
    ((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0)),
    ((-0.5, -0.5, 1), (0, 0, -1), (0, 1, 0)),
    ((0.5, -0.5, 0), (0, 0, 1), (0, 1, 0)),
    ((-0.5, -0.5, 1), (1, 0, 0), (0, 0, -1)),
    ((-0.5, 0.5, 0), (1, 0, 0), (0, 0, 1)),
)
SCENES = {"dihedral": _DIHEDRAL, "trihedral": _TRIHEDRAL, "box": _BOX}
"""Walls by the name of the scene."""
EYE = 3.0
"""Where on the z axis the projector is."""
_MARGIN = 1.02  # of the frame around the walls


@contextlib.contextmanager
def within(mi: Any, variant: str) -> Iterator[None]:
    """Mitsuba's variant, which is one for the whole process, as long as it is needed."""
    before = mi.variant()
    mi.set_variant(variant)
    try:
        yield
    finally:
        if before is not None:
            mi.set_variant(before)


def mitsuba_scene(
    name: str,
    grid: tuple[int, int],
    albedo: Any = 0.7,
    *,
    camera_grid: tuple[int, int] | None = None,
    baseline: float = 0.0,
    depth: int = 16,
) -> dict[str, Any]:
    """A scene for `mitsuba.load_dict`, and for `MitsubaRig`, which puts the pattern in its projector.

    Parameters
    ----------
    name : "dihedral", "trihedral" or "box"
    grid : (h, w)
        Of the projector.
    albedo : array_like in [0, 1)
        A scalar; (3,), one colour; (walls, 3), one colour per wall, in the order above.
    camera_grid : (H, W), optional
        Of the camera; that of the projector if omitted.
    baseline : float
        How far to the right of the projector the camera is; 0: in the same place.
    depth : int
        Longest path from the camera to the projector, in edges; 2 is direct light alone.

    Returns
    -------
    dict
        Plugins by name, with "sensor", "projector", "wall 1" and so on among them.

    Raises
    ------
    InputError
        Another name, or a grid, an albedo, a distance or a depth out of range.
    AcquisitionError
        Mitsuba is not installed.

    Examples
    --------
    >>> scene = mitsuba_scene("dihedral", (48, 64), albedo=[(0.7, 0.1, 0.1), (0.1, 0.7, 0.1)])
    >>> sorted(scene)
    ['integrator', 'projector', 'sensor', 'type', 'wall 1', 'wall 2']
    """
    walls = SCENES[checks.one_of("name", name, SCENES)]
    grid = checks.grid("grid", grid)
    camera_grid = grid if camera_grid is None else checks.grid("camera_grid", camera_grid)
    colours = _colours(albedo, len(walls))
    x = checks.number("baseline", baseline, least=-2.0, most=2.0)
    depth = checks.count("depth", depth, least=2)
    mi = extras.load("mitsuba", "rig", "a scene of Mitsuba")
    corners = np.concatenate([_corners(*wall) for wall in walls])
    with within(mi, "scalar_rgb"):
        scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": depth}}
        for k, (wall, colour) in enumerate(zip(walls, colours, strict=True), 1):
            scene[f"wall {k}"] = _wall(mi, wall, colour)
        scene["projector"] = {"type": "projector", **_pinhole(mi, 0.0, grid, corners)}
        scene["sensor"] = {"type": "perspective", **_pinhole(mi, x, camera_grid, corners)}
        scene["sensor"]["film"] = _film(camera_grid)
    return scene


def _colours(albedo: Any, walls: int) -> np.ndarray:
    """(walls, 3)."""
    array = checks.finite("albedo", checks.real("albedo", albedo))
    checks.shape("albedo", array, (), (3,), (walls, 3))
    if array.min() < 0 or array.max() >= 1:
        raise InputError(f"albedo reaches from {array.min():g} to {array.max():g}; it must be in [0, 1)")
    return np.broadcast_to(array, (walls, 3))


def _corners(corner: Any, right: Any, up: Any) -> np.ndarray:
    """(4, 3)."""
    start, a, b = (np.asarray(part, np.float64) for part in (corner, right, up))
    return np.array([start, start + a, start + b, start + a + b])


def _wall(mi: Any, wall: _Wall, colour: np.ndarray) -> dict[str, Any]:
    """Mitsuba's rectangle, [-1, 1]^2 with its front towards z, moved onto the wall."""
    start, a, b = (np.asarray(part, np.float64) for part in wall)
    place = np.eye(4)
    place[:3, 0], place[:3, 1], place[:3, 2] = a / 2, b / 2, np.cross(a, b)
    place[:3, 3] = start + a / 2 + b / 2
    reflectance = {"type": "rgb", "value": [float(part) for part in colour]}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(place),
        "bsdf": {"type": "diffuse", "reflectance": reflectance},
    }


def _pinhole(mi: Any, x: float, grid: tuple[int, int], corners: np.ndarray) -> dict[str, Any]:
    """Place and angle of a frame of the grid's shape around all the corners, seen from (x, 0, EYE)."""
    eye = np.array([x, 0.0, EYE])
    forward = -eye / np.linalg.norm(eye)
    across = np.cross(forward, (0.0, 1.0, 0.0))
    away = corners - eye
    far = away @ forward
    wide = np.abs(away @ (across / np.linalg.norm(across)) / far).max()
    high = np.abs(away[:, 1] / far).max()
    tangent = _MARGIN * max(wide, high * grid[1] / grid[0])
    return {
        "fov": math.degrees(2 * math.atan(tangent)),
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f().look_at(origin=list(eye), target=[0, 0, 0], up=[0, 1, 0]),
    }


def _film(grid: tuple[int, int]) -> dict[str, Any]:
    """Each pixel is the mean of what it sees, without a share of its neighbours."""
    return {
        "type": "hdrfilm",
        "height": grid[0],
        "width": grid[1],
        "pixel_format": "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
