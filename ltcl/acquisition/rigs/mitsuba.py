# SPDX-License-Identifier: BSD-3-Clause
"""`MitsubaRig`: photographs of a scene that Mitsuba 3 renders (extra `rig`).

Every pattern is rendered with the same seed: radiance is linear in the projector's light, and noise
between photographs is that of the sensor. Known limit: the renderer's own noise is part of T.

In a named scene walls are diffuse unit squares, y is up. The projector, on the z axis, looks
towards -z. It and the camera are pinholes whose frames hold all walls, so that T contains all
light.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import load_extra
from ltcl.acquisition.rigs.simulated import SimulatedRig
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from ltcl.files import input_file

_VARIANT = "scalar_rgb"  # of Mitsuba's builds the one that runs everywhere
_DISTANCE = 3.0  # of the projector from the origin
_MARGIN = 1.02  # of the frame around the walls
_HALF, _THIRD, _WIDE = math.sqrt(1 / 2), math.sqrt(1 / 3), math.sqrt(2 / 3)
_AXES = [
    (_WIDE * math.cos(a), _WIDE * math.sin(a), _THIRD) for a in np.pi * np.array([3, 7, 11]) / 6
]
# Walls by the name of the scene: corner (3,), and both edges from it; right x up faces the viewer's
# side.
SCENES: dict[str, Any] = {
    "dihedral": (  # an upright edge at z = 0
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
    """A projector and a camera in a rendered scene.

    Parameters
    ----------
    scene : "dihedral", "trihedral", "box", dict or path
        A name; or a dict for `mitsuba.load_dict` or an XML file, with one emitter of type
        "projector", whose `irradiance` is replaced, and one sensor. Other emitters are ambient
        light.
    projector_grid, camera_grid : (h, w), (H, W)
        By default the camera has the film of the scene, or `projector_grid` in a named one.
    channels, samples : 1 or 3, int
        One channel is the green one; paths for each camera pixel.
    sensitivity : float, optional
        Linear value for radiance 1 in one second; by default the brightest 1 % of the white picture
        has 0.5.
    albedo, baseline, depth : array_like in [0, 1), float, int
        Of a named scene: (), (3,) or (walls, 3), 0.7 by default; how far to the right of the
        projector the camera is, at most 2; longest path in edges (2 is direct light alone), 16 by
        default.
    **sensor : of `ltcl.acquisition.rigs.virtual.Sensor`

    Examples
    --------
    >>> rig = MitsubaRig("dihedral", (12, 16), samples=16)
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
        sensitivity: float | None = None,
        albedo: Any = None,
        baseline: float | None = None,
        depth: int | None = None,
        **sensor: Any,
    ) -> None:
        grid = checks.grid("projector_grid", projector_grid)
        super().__init__(grid, checks.one_of("channels", channels, (1, 3)), sensor)
        size = None if camera_grid is None else checks.grid("camera_grid", camera_grid)
        checks.number("sensitivity", 1.0 if sensitivity is None else sensitivity, above=0.0)
        if not isinstance(scene, (dict, str, os.PathLike)):
            raise InputTypeError(
                f"scene is a {type(scene).__name__}; it must be a name, dict or XML file"
            )
        self._mi = mi = load_extra("mitsuba", "rig", "MitsubaRig")
        name = "dict" if isinstance(scene, dict) else os.path.basename(os.fspath(scene))
        self._facts = {
            "kind": "mitsuba",
            "scene": name,
            "mitsuba": mi.__version__,
            "variant": _VARIANT,
        }
        self._facts["samples"] = checks.count("samples", samples)
        options = {"albedo": albedo, "baseline": baseline, "depth": depth}
        options = {name: value for name, value in options.items() if value is not None}
        with self._mitsuba(InputError, "scene cannot be loaded"):
            if isinstance(scene, str) and scene in SCENES:
                scene = _named_scene(mi, scene, grid, size or grid, options)
            elif options:
                raise InputError(
                    f"{next(iter(options))} is of {', '.join(SCENES)}; others have their own"
                )
            self._scene = _load(mi, scene, grid)
            self._parameters = mi.traverse(self._scene)
            if size is not None:
                self._parameters[self._key("film.size")] = mi.ScalarVector2u(*size[::-1])
                self._parameters.update()
        if sensitivity is None:
            bright = float(np.percentile(self.radiance(np.ones(grid)), 99))
            if bright <= 0:
                raise InputError(
                    "scene shows no light of its projector: its sensor looks elsewhere"
                )
            sensitivity = 0.5 / bright
        self.sensitivity = float(sensitivity)

    def _key(self, end: str) -> str:
        (key,) = (key for key in self._parameters.keys() if key.endswith(end))  # noqa: SIM118
        return key

    @contextlib.contextmanager
    def _mitsuba(self, kind: type[Exception], subject: str) -> Iterator[None]:
        """Mitsuba with its variant, one for the whole process, for a while; its errors in one line."""
        before = self._mi.variant()
        self._mi.set_variant(_VARIANT)
        try:
            yield
        except RuntimeError as error:
            raise kind(f"{subject} by Mitsuba: {' '.join(str(error).split()):.300}") from error
        finally:
            if before is not None:
                self._mi.set_variant(before)

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        p = self._light(codes).astype(np.float32)
        p = np.ascontiguousarray(p if p.ndim == 3 else np.repeat(p[..., None], 3, axis=-1))
        with self._mitsuba(AcquisitionError, "the scene cannot be rendered"):
            self._parameters[self._key("irradiance.data")] = self._mi.TensorXf(p)
            self._parameters.update()
            options = {"spp": self._facts["samples"], "seed": self.sensor.seed}
            image = np.array(self._mi.render(self._scene, **options), np.float64)
        if image.ndim != 3 or image.shape[2] < 3 or not np.isfinite(image).all():
            raise AcquisitionError(
                f"Mitsuba rendered {image.shape}, or NaN; it must be finite (H, W, 3)"
            )
        return image[..., 1] if self.channels == 1 else image[..., :3]


def _named_scene(
    mi: Any, name: str, grid: tuple[int, int], camera_grid: tuple[int, int], options: dict[str, Any]
) -> dict[str, Any]:
    walls = np.array(SCENES[name], np.float64)  # (walls, 3 vectors, 3)
    colours = checks.finite("albedo", checks.real("albedo", options.get("albedo", 0.7)))
    checks.shape("albedo", colours, (), (3,), (len(walls), 3))
    if colours.min() < 0 or colours.max() >= 1:
        raise InputError(
            f"albedo reaches from {colours.min():g} to {colours.max():g}; it must be in [0, 1)"
        )
    x = checks.number("baseline", options.get("baseline", 0.0), least=-2.0, most=2.0)
    depth = checks.count("depth", options.get("depth", 16), least=2)
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": depth}}
    for k, (start, right, up) in enumerate(walls):
        axes = (
            right / 2,
            up / 2,
            np.cross(right, up),
            start + (right + up) / 2,
        )  # of [-1, 1]^2, front to z
        colour = np.broadcast_to(colours, (len(walls), 3))[k].tolist()
        scene[f"wall {k + 1}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(np.vstack([np.transpose(axes), [0, 0, 0, 1]])),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}},
        }
    film = {"type": "hdrfilm", "component_format": "float32", "rfilter": {"type": "box"}}
    film |= {"height": camera_grid[0], "width": camera_grid[1], "pixel_format": "rgb"}
    corners = np.concatenate(
        [walls[:, 0] + a * walls[:, 1] + b * walls[:, 2] for a, b in np.ndindex(2, 2)]
    )
    scene["projector"] = {"type": "projector", **_pinhole(mi, 0.0, grid, corners)}
    scene["sensor"] = {"type": "perspective", **_pinhole(mi, x, camera_grid, corners), "film": film}
    return scene


def _pinhole(mi: Any, x: float, grid: tuple[int, int], corners: np.ndarray) -> dict[str, Any]:
    """Place and angle of a frame of the grid's shape around all the corners, seen from x."""
    eye = np.array([x, 0.0, _DISTANCE])
    forward = -eye / np.linalg.norm(eye)
    across = np.cross(forward, (0.0, 1.0, 0.0))
    far = (corners - eye) @ forward
    wide = np.abs((corners - eye) @ (across / np.linalg.norm(across)) / far).max()
    high = np.abs(corners[:, 1] / far).max()
    tangent = _MARGIN * max(wide, high * grid[1] / grid[0])
    there = mi.ScalarTransform4f().look_at(origin=list(eye), target=[0, 0, 0], up=[0, 1, 0])
    return {"fov": math.degrees(2 * math.atan(tangent)), "fov_axis": "x", "to_world": there}


def _load(mi: Any, scene: Any, grid: tuple[int, int]) -> Any:
    """The scene of a dict or an XML file, with a white pattern of sharp pixels in its one projector."""
    settings, is_dict = mi.parser.ParserConfig(_VARIANT), isinstance(scene, dict)
    parse = mi.parser.parse_dict if is_dict else mi.parser.parse_file
    parsed = parse(settings, scene if is_dict else str(input_file(scene)))
    projectors = [node for node in parsed.nodes if node.props.plugin_name() == "projector"]
    if len(projectors) != 1:
        raise InputError(
            f"scene has {len(projectors)} projectors; it must have one emitter of that type"
        )
    white = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((*grid, 3), np.float32)), "raw": True}
    projectors[0].props["irradiance"] = mi.load_dict(
        white | {"filter_type": "nearest", "wrap_mode": "clamp"}
    )
    mi.parser.transform_all(settings, parsed)
    loaded = mi.parser.instantiate(settings, parsed)
    loaded = loaded[0] if isinstance(loaded, list) else loaded
    if not hasattr(loaded, "sensors") or len(loaded.sensors()) != 1:
        raise InputError("scene is no scene with one sensor; it must have one")
    return loaded
