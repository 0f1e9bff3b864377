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
from ltcl.acquisition.rigs.simulated import SimulatedRig
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from ltcl.files import input_file

# The one of Mitsuba's builds that runs everywhere.
VARIANT = "scalar_rgb"

# Defaults of named scenes.
DEFAULT_ALBEDO = 0.7
DEFAULT_BASELINE = 0.0
DEFAULT_DEPTH = 16

# Distance of the projector from the origin.
PROJECTOR_DISTANCE = 3.0

# Size of a frame, of the walls in it.
FRAME_MARGIN = 1.02

# Without `sensitivity`, this percentile of the white picture has this linear value.
BRIGHT_PERCENTILE = 99
BRIGHT_VALUE = 0.5


def _trihedral_walls() -> tuple[Any, ...]:
    """Three walls around the origin, whose edges lean towards the viewer."""
    across = math.sqrt(2 / 3)
    along = math.sqrt(1 / 3)
    edges = []
    for angle in np.pi * np.array([3, 7, 11]) / 6:
        edges.append((across * math.cos(angle), across * math.sin(angle), along))
    a, b, c = edges
    origin = (0, 0, 0)
    return (origin, a, b), (origin, b, c), (origin, c, a)


HALF = math.sqrt(1 / 2)

# Walls by the name of the scene: corner (3,), and both edges from it; right x up faces the viewer's
# side.
SCENES: dict[str, Any] = {
    "dihedral": (  # an upright edge at z = 0
        ((-HALF, -0.5, HALF), (HALF, 0, -HALF), (0, 1, 0)),
        ((0, -0.5, 0), (HALF, 0, HALF), (0, 1, 0)),
    ),
    "trihedral": _trihedral_walls(),
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
    projector_grid : (int, int)
        Height and width of the projector.
    camera_grid : (int, int), optional
        Height and width of the camera; None for the film of the scene, or `projector_grid` in a
        named one.
    channels : 1 or 3
        One channel is the green one.
    samples : int
        Paths for each camera pixel.
    sensitivity : float, optional
        Linear value for radiance 1 in one second; by default the brightest 1 % of the white picture
        has 0.5.
    albedo : (), (3,) or (walls, 3) array_like in [0, 1), optional
        Albedo of the walls of a named scene; 0.7 by default.
    baseline : float, optional
        Distance in a named scene from the projector to the camera at its right, at most 2; 0 by
        default.
    depth : int, optional
        Longest path in a named scene, in edges (2 is direct light alone); 16 by default.
    **sensor
        Settings of `ltcl.acquisition.rigs.simulated.Sensor`.

    Raises
    ------
    InputError, InputTypeError
        An argument or the scene cannot be used.
    FileError
        The file of the scene is missing.
    AcquisitionError
        Mitsuba is not installed.

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
        checks.one_of("channels", channels, (1, 3))
        super().__init__(grid, channels, sensor)
        if camera_grid is not None:
            camera_grid = checks.grid("camera_grid", camera_grid)
        if sensitivity is not None:
            checks.number("sensitivity", sensitivity, above=0.0)
        if not isinstance(scene, (dict, str, os.PathLike)):
            raise InputTypeError(
                f"scene is a {type(scene).__name__}; it must be a name, dict or XML file"
            )
        self._samples = checks.count("samples", samples)
        self._mi = checks.load_extra("mitsuba", "rig", "MitsubaRig", AcquisitionError)
        name = "dict"
        if not isinstance(scene, dict):
            name = os.path.basename(os.fspath(scene))
        self._facts = {
            "kind": "mitsuba",
            "scene": name,
            "mitsuba": self._mi.__version__,
            "variant": VARIANT,
            "samples": self._samples,
        }
        options = {}
        for option, value in (("albedo", albedo), ("baseline", baseline), ("depth", depth)):
            if value is not None:
                options[option] = value
        with self._mitsuba(InputError, "scene cannot be loaded"):
            self._load(scene, camera_grid, options)
        if sensitivity is None:
            sensitivity = self._default_sensitivity()
        self.sensitivity = float(sensitivity)

    def _load(
        self, scene: Any, camera_grid: tuple[int, int] | None, options: dict[str, Any]
    ) -> None:
        """Load a scene of any kind, and set the size of its film."""
        mi = self._mi
        grid = self.projector_grid
        if isinstance(scene, str) and scene in SCENES:
            film_grid = grid if camera_grid is None else camera_grid
            scene = _named_scene(mi, scene, grid, film_grid, **options)
        elif options:
            first = next(iter(options))
            names = ", ".join(SCENES)
            raise InputError(f"{first} is given; only the named scenes {names} take it")
        self._scene = _load_scene(mi, scene, grid)
        self._parameters = mi.traverse(self._scene)
        if camera_grid is not None:
            height, width = camera_grid
            size = mi.ScalarVector2u(width, height)
            self._set_parameter("film.size", size)

    def _default_sensitivity(self) -> float:
        white = self.radiance(np.ones(self.projector_grid))
        bright = float(np.percentile(white, BRIGHT_PERCENTILE))
        if bright <= 0:
            raise InputError("scene shows no light of its projector: its sensor looks elsewhere")
        return BRIGHT_VALUE / bright

    def _set_parameter(self, ending: str, value: Any) -> None:
        """Set the one parameter of the scene whose name has this ending."""
        names = self._parameters.keys()
        (name,) = [name for name in names if name.endswith(ending)]
        self._parameters[name] = value
        self._parameters.update()

    @contextlib.contextmanager
    def _mitsuba(self, kind: type[Exception], subject: str) -> Iterator[None]:
        """Set Mitsuba's variant, one for the whole process, for a while; its errors in one line."""
        before = self._mi.variant()
        self._mi.set_variant(VARIANT)
        try:
            yield
        except RuntimeError as error:
            reason = " ".join(str(error).split())
            raise kind(f"{subject} by Mitsuba: {reason:.300}") from error
        finally:
            if before is not None:
                self._mi.set_variant(before)

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        light = self._light(codes).astype(np.float32)
        if light.ndim == 2:
            light = np.repeat(light[..., None], 3, axis=-1)
        light = np.ascontiguousarray(light)
        with self._mitsuba(AcquisitionError, "the scene cannot be rendered"):
            self._set_parameter("irradiance.data", self._mi.TensorXf(light))
            seed = self.sensor.seed
            rendered = self._mi.render(self._scene, spp=self._samples, seed=seed)
            image = np.array(rendered, np.float64)
        is_colour = image.ndim == 3 and image.shape[2] >= 3
        if not is_colour or not np.isfinite(image).all():
            raise AcquisitionError(
                f"Mitsuba rendered {image.shape}, or NaN; it must be finite (H, W, 3)"
            )
        if self.channels == 1:
            return image[..., 1]
        return image[..., :3]


def _named_scene(
    mi: Any,
    name: str,
    grid: tuple[int, int],
    camera_grid: tuple[int, int],
    *,
    albedo: Any = DEFAULT_ALBEDO,
    baseline: float = DEFAULT_BASELINE,
    depth: int = DEFAULT_DEPTH,
) -> dict[str, Any]:
    """Description of a named scene for `mitsuba.load_dict`."""
    walls = np.array(SCENES[name], np.float64)  # (walls, 3 vectors, 3)
    colours = _wall_colours(albedo, len(walls))
    checks.number("baseline", baseline, least=-2.0, most=2.0)
    max_depth = checks.count("depth", depth, least=2)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": max_depth},
    }
    for k, wall in enumerate(walls):
        scene[f"wall {k + 1}"] = _wall(mi, wall, colours[k].tolist())
    start = walls[:, 0]
    right = walls[:, 1]
    up = walls[:, 2]
    end = start + right
    corners = np.concatenate([start, start + up, end, end + up])
    height, width = camera_grid
    film = {
        "type": "hdrfilm",
        "component_format": "float32",
        "rfilter": {"type": "box"},
        "height": height,
        "width": width,
        "pixel_format": "rgb",
    }
    projector = _pinhole(mi, 0.0, grid, corners)
    sensor = _pinhole(mi, float(baseline), camera_grid, corners)
    scene["projector"] = {"type": "projector", **projector}
    scene["sensor"] = {"type": "perspective", **sensor, "film": film}
    return scene


def _wall_colours(albedo: Any, walls: int) -> np.ndarray:
    """Albedo of each wall, (walls, 3)."""
    colours = checks.finite("albedo", checks.real("albedo", albedo))
    checks.shape("albedo", colours, (), (3,), (walls, 3))
    if colours.min() < 0 or colours.max() >= 1:
        reach = f"{colours.min():g} to {colours.max():g}"
        raise InputError(f"albedo reaches from {reach}; it must be in [0, 1)")
    return np.broadcast_to(colours, (walls, 3))


def _wall(mi: Any, wall: np.ndarray, colour: list[float]) -> dict[str, Any]:
    """Description of a wall: Mitsuba's rectangle is [-1, 1]^2, with its front to z."""
    start, right, up = wall
    normal = np.cross(right, up)
    middle = start + (right + up) / 2
    columns = np.stack([right / 2, up / 2, normal, middle], axis=1)
    place = np.vstack([columns, [0, 0, 0, 1]])
    reflectance = {"type": "rgb", "value": colour}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(place),
        "bsdf": {"type": "diffuse", "reflectance": reflectance},
    }


def _pinhole(mi: Any, x: float, grid: tuple[int, int], corners: np.ndarray) -> dict[str, Any]:
    """Place and angle of a frame of the grid's shape around all the corners, seen from x."""
    height, width = grid
    eye = np.array([x, 0.0, PROJECTOR_DISTANCE])
    forward = -eye / np.linalg.norm(eye)
    across = np.cross(forward, (0.0, 1.0, 0.0))
    right = across / np.linalg.norm(across)
    distance = (corners - eye) @ forward
    half_width = np.abs((corners - eye) @ right / distance).max()
    half_height = np.abs(corners[:, 1] / distance).max()
    tangent = FRAME_MARGIN * max(half_width, half_height * width / height)
    place = mi.ScalarTransform4f().look_at(origin=list(eye), target=[0, 0, 0], up=[0, 1, 0])
    angle = math.degrees(2 * math.atan(tangent))
    return {"fov": angle, "fov_axis": "x", "to_world": place}


def _load_scene(mi: Any, scene: Any, grid: tuple[int, int]) -> Any:
    """The scene of a dict or an XML file, with a white pattern of sharp pixels in its projector."""
    settings = mi.parser.ParserConfig(VARIANT)
    if isinstance(scene, dict):
        parsed = mi.parser.parse_dict(settings, scene)
    else:
        parsed = mi.parser.parse_file(settings, str(input_file(scene)))
    projectors = []
    for node in parsed.nodes:
        if node.props.plugin_name() == "projector":
            projectors.append(node)
    if len(projectors) != 1:
        count = len(projectors)
        raise InputError(f"scene has {count} projectors; it must have one emitter of that type")
    white = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ones((*grid, 3), np.float32)),
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
    }
    projectors[0].props["irradiance"] = mi.load_dict(white)
    mi.parser.transform_all(settings, parsed)
    loaded = mi.parser.instantiate(settings, parsed)
    if isinstance(loaded, list):
        loaded = loaded[0]
    if not hasattr(loaded, "sensors") or len(loaded.sensors()) != 1:
        raise InputError("scene must have exactly one sensor")
    return loaded
