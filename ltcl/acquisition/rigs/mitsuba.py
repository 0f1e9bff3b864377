# SPDX-License-Identifier: BSD-3-Clause
"""`MitsubaRig`: photographs of a scene in Mitsuba 3 (extra `rig`); `mitsuba_scene`: corners and a room.

Every pattern is rendered with the same seed: paths depend on the scene, not on the pattern, so radiance is
linear in the projector's light, without noise between photographs, as before a scene that stands still. The
renderer's own noise leaves a T that differs a little from the true one, and consistently. Noise of
photographs comes from the sensor alone.

The viewer is on the z axis and looks towards -z, y is up. Walls are diffuse unit squares:

    dihedral    two that meet in an upright edge at z = 0
    trihedral   three that meet in the origin, the corner of a cube seen along its diagonal
    box         five, the inside of a cube from its open front: back, left, right, floor, ceiling

Projector and camera are pinholes whose frames hold all the walls, so that no surface reflects which the
projector does not light: T then contains all light. Around the walls it is black.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import load_extra
from ltcl.acquisition.rigs.sensor import SimulatedRig
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from ltcl.files import input_file

_PERCENTILE, _FILL = 99.0, 0.5  # of the picture in white light, and the part of a pixel it is to fill
_SCALAR, _VECTOR = "scalar_rgb", "llvm_ad_rgb"
_TRIAL = 120  # seconds at most
_EYE = 3.0  # where on the z axis the projector is
_MARGIN = 1.02  # of the frame around the walls
_HALF, _THIRD, _WIDE = math.sqrt(1 / 2), math.sqrt(1 / 3), math.sqrt(2 / 3)
_AXES = [(_WIDE * math.cos(a), _WIDE * math.sin(a), _THIRD) for a in np.pi * np.array([3, 7, 11]) / 6]
# Walls by the name of the scene: corner (3,), and both edges from it; right x up faces the viewer's side.
SCENES: dict[str, Any] = {
    "dihedral": (
        ((-_HALF, -0.5, _HALF), (_HALF, 0, -_HALF), (0, 1, 0)),
        ((0, -0.5, 0), (_HALF, 0, _HALF), (0, 1, 0)),
    ),
    "trihedral": tuple(((0, 0, 0), _AXES[k], _AXES[(k + 1) % 3]) for k in range(3)),
    "box": (
        ((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0)),
        ((-0.5, -0.5, 1), (0, 0, -1), (0, 1, 0)),
        ((0.5, -0.5, 0), (0, 0, 1), (0, 1, 0)),
        ((-0.5, -0.5, 1), (1, 0, 0), (0, 0, -1)),
        ((-0.5, 0.5, 0), (1, 0, 0), (0, 0, 1)),
    ),
}


class MitsubaRig(SimulatedRig):
    """A projector and a camera in a scene that Mitsuba 3 renders.

    Parameters
    ----------
    scene : "dihedral", "trihedral", "box", dict or path
        A name of `mitsuba_scene`; or a dict for `mitsuba.load_dict` or an XML file, with one emitter of type
        "projector" and one sensor. The projector's `irradiance` is replaced; other emitters are ambient
        light.
    projector_grid : (h, w)
    camera_grid : (H, W), optional
        Of the photographs; if omitted, what the film of the scene has, or `projector_grid` of a named scene.
    channels : 1 or 3
        Of codes and photographs; one channel is the green one.
    samples : int
        Paths for each camera pixel.
    variant : "auto" or the name of an RGB variant
        Of Mitsuba. "auto" is llvm_ad_rgb where a trial in a process of its own renders, else scalar_rgb.
    sensitivity : float, optional
        Linear sensor value for radiance 1 in one second; None: the brightest hundredth of the picture in
        white light fills half a pixel in one second.
    **sensor
        response, projector_response, bits, black, projector_black, gain, read, exposures, seed: see
        `ltcl.acquisition.rigs.sensor.SimulatedRig`; the paths have the same seed.

    InputError for a scene that Mitsuba cannot load, or without one projector and one sensor; AcquisitionError
    where Mitsuba is not installed.

    Examples
    --------
    >>> rig = MitsubaRig("dihedral", (12, 16), samples=16, variant="scalar_rgb")
    >>> rig.photograph(np.ones((12, 16)), seconds=1.0).shape
    (12, 16, 3)
    """

    def __init__(
        self,
        scene: Any,
        projector_grid: tuple[int, int],
        *,
        camera_grid: tuple[int, int] | None = None,
        channels: int = 3,
        samples: int = 64,
        variant: str = "auto",
        sensitivity: float | None = None,
        **sensor: Any,
    ) -> None:
        grid = checks.grid("projector_grid", projector_grid)
        super().__init__(grid, checks.one_of("channels", channels, (1, 3)), **sensor)
        self._samples = checks.count("samples", samples)
        if sensitivity is not None:
            checks.number("sensitivity", sensitivity, above=0.0)
        if camera_grid is not None:
            camera_grid = checks.grid("camera_grid", camera_grid)
        if not isinstance(scene, (dict, str, os.PathLike)):
            names, kind = ", ".join(SCENES), type(scene).__name__
            raise InputTypeError(f"scene is a {kind}; it must be one of {names}, a dict or an XML file")
        self._scene_name = "dict" if isinstance(scene, dict) else os.path.basename(os.fspath(scene))
        self._mi = load_extra("mitsuba", "rig", "MitsubaRig")
        self._variant = _choose_variant(self._mi, variant)
        if isinstance(scene, str) and scene in SCENES:
            scene, camera_grid = mitsuba_scene(scene, grid, camera_grid=camera_grid), None
        with within(self._mi, self._variant):
            self._scene = _load(self._mi, self._variant, scene, grid)
            self._parameters = self._mi.traverse(self._scene)
            if camera_grid is not None:
                self._parameters[self._key("film.size")] = self._mi.ScalarVector2u(*camera_grid[::-1])
                self._parameters.update()
        if sensitivity is None:
            bright = float(np.percentile(self.radiance(np.ones(grid)), _PERCENTILE))
            if bright <= 0:
                raise InputError("scene shows no light of its projector: its sensor looks elsewhere")
            sensitivity = _FILL / bright
        self.sensitivity = float(sensitivity)

    def describe(self) -> dict[str, Any]:
        """What makes the photographs, as plain JSON."""
        return {
            "kind": "mitsuba",
            "scene": self._scene_name,
            "mitsuba": str(self._mi.__version__),
            "variant": self._variant,
            "samples": self._samples,
            **super().describe(),
        }

    def _key(self, end: str) -> str:
        (key,) = (key for key in self._parameters.keys() if key.endswith(end))  # noqa: SIM118
        return key

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        p = self._light(codes)
        p = np.repeat(p[..., None], 3, axis=-1) if p.ndim == 2 else p
        mi = self._mi
        with within(mi, self._variant):
            try:
                self._parameters[self._key("irradiance.data")] = mi.TensorXf(
                    np.ascontiguousarray(p, np.float32)
                )
                self._parameters.update()
                image = np.array(mi.render(self._scene, spp=self._samples, seed=self._seed), np.float64)
            except RuntimeError as error:
                raise AcquisitionError(f"Mitsuba cannot render the scene: {_one_line(error)}") from error
        if image.ndim != 3 or image.shape[2] < 3 or not np.isfinite(image).all():
            raise AcquisitionError(f"Mitsuba rendered {image.shape}, or NaN; it must be finite (H, W, 3)")
        return image[..., 1] if self.channels == 1 else image[..., :3]


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
    grid, camera_grid : (h, w), (H, W)
        Of the projector, and of the camera if that is another.
    albedo : array_like in [0, 1)
        A scalar; (3,), one colour; (walls, 3), one colour per wall, in the order above.
    baseline : float
        How far to the right of the projector the camera is; 0: in the same place.
    depth : int
        Longest path from the camera to the projector, in edges; 2 is direct light alone.

    Examples
    --------
    >>> scene = mitsuba_scene("dihedral", (48, 64), albedo=[(0.7, 0.1, 0.1), (0.1, 0.7, 0.1)])
    >>> sorted(scene)
    ['integrator', 'projector', 'sensor', 'type', 'wall 1', 'wall 2']
    """
    walls = np.array(SCENES[checks.one_of("name", name, SCENES)], np.float64)  # (walls, 3 vectors, 3)
    grid = checks.grid("grid", grid)
    camera_grid = grid if camera_grid is None else checks.grid("camera_grid", camera_grid)
    colours = checks.finite("albedo", checks.real("albedo", albedo))
    checks.shape("albedo", colours, (), (3,), (len(walls), 3))
    if colours.min() < 0 or colours.max() >= 1:
        raise InputError(f"albedo reaches from {colours.min():g} to {colours.max():g}; it must be in [0, 1)")
    x = checks.number("baseline", baseline, least=-2.0, most=2.0)
    depth = checks.count("depth", depth, least=2)
    mi = load_extra("mitsuba", "rig", "a scene of Mitsuba")
    start, right, up = walls[:, 0], walls[:, 1], walls[:, 2]
    corners = np.concatenate([start, start + right, start + up, start + right + up])
    with within(mi, _SCALAR):
        scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": depth}}
        for k, colour in enumerate(np.broadcast_to(colours, (len(walls), 3))):
            # Mitsuba's rectangle is [-1, 1]^2 with its front towards z.
            axes = right[k] / 2, up[k] / 2, np.cross(right[k], up[k]), start[k] + (right[k] + up[k]) / 2
            reflectance = {"type": "rgb", "value": colour.tolist()}
            scene[f"wall {k + 1}"] = {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f(np.vstack([np.transpose(axes), [0, 0, 0, 1]])),
                "bsdf": {"type": "diffuse", "reflectance": reflectance},
            }
        scene["projector"] = {"type": "projector", **_pinhole(mi, 0.0, grid, corners)}
        # A box filter: each pixel is the mean of what it sees alone.
        film = {"type": "hdrfilm", "component_format": "float32", "rfilter": {"type": "box"}}
        film |= {"height": camera_grid[0], "width": camera_grid[1], "pixel_format": "rgb"}
        scene["sensor"] = {"type": "perspective", **_pinhole(mi, x, camera_grid, corners), "film": film}
    return scene


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


def _choose_variant(mi: Any, name: str) -> str:
    offered = [variant for variant in mi.variants() if variant.endswith("_rgb")]
    if checks.one_of("variant", name, ["auto", *offered]) != "auto":
        return name
    return _VECTOR if _VECTOR in offered and _can_render(_VECTOR) else _SCALAR


@functools.cache
def _can_render(variant: str) -> bool:
    """Whether a small scene is rendered by a process of its own, which some versions of LLVM abort."""
    trial = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        f"from ltcl.acquisition.rigs.mitsuba import MitsubaRig\n"
        f"MitsubaRig('box', (4, 4), samples=1, variant={variant!r})"
    )
    try:
        run = subprocess.run([sys.executable, "-c", trial], capture_output=True, timeout=_TRIAL)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired):
        return False
    return run.returncode == 0


def _load(mi: Any, variant: str, scene: Any, grid: tuple[int, int]) -> Any:
    """The scene of a dict or an XML file, with a white pattern of sharp pixels in its one projector."""
    path = None if isinstance(scene, dict) else str(input_file(scene))
    settings = mi.parser.ParserConfig(variant)
    try:
        parsed = (
            mi.parser.parse_dict(settings, scene) if path is None else mi.parser.parse_file(settings, path)
        )
        projectors = [node for node in parsed.nodes if node.props.plugin_name() == "projector"]
        if len(projectors) != 1:
            raise InputError(f"scene has {len(projectors)} projectors; it must have one emitter of that type")
        white = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((*grid, 3), np.float32)), "raw": True}
        sharp = {"filter_type": "nearest", "wrap_mode": "clamp"}
        projectors[0].props["irradiance"] = mi.load_dict(white | sharp)
        mi.parser.transform_all(settings, parsed)
        loaded = mi.parser.instantiate(settings, parsed)
    except RuntimeError as error:
        raise InputError(f"scene cannot be loaded by Mitsuba: {_one_line(error)}") from error
    loaded = loaded[0] if isinstance(loaded, list) else loaded
    if not hasattr(loaded, "sensors") or len(loaded.sensors()) != 1:
        raise InputError("scene is no scene with one sensor; it must have one")
    return loaded


def _pinhole(mi: Any, x: float, grid: tuple[int, int], corners: np.ndarray) -> dict[str, Any]:
    """Place and angle of a frame of the grid's shape around all the corners, seen from (x, 0, _EYE)."""
    eye = np.array([x, 0.0, _EYE])
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


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:300]
