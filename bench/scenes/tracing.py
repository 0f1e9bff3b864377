# SPDX-License-Identifier: BSD-3-Clause
"""T of a scene by bounces, and photographs of it, by an independent renderer: Mitsuba 3 traces.

Nothing here uses an inverse. Paths of `trace` begin in a camera pixel i. Every vertex is connected
to the projector, whose pixel j shines there: the light it reflects towards the path is a sample of
T[i, j], of the bounce that the vertex is. So one pass yields whole rows. `photographs` are
Mitsuba's own, by its path integrator and its projector. Camera and projector are one pinhole; pixel
j of the projector gives irradiance 1 on a plane at distance 1. Mitsuba's wavefronts need LLVM:
`unavailable` says why they do not run.
"""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ltcl.acquisition.rigs.mitsuba import SCENES

# Direct light, bounces 1 to 3, and all further ones.
BOUNCES = 5
# Vertices of a path, and those before Russian roulette.
DEPTH = 64
ROULETTE_DEPTH = 4
MAX_SURVIVAL = 0.95
# Paths at once.
WAVEFRONT = 1 << 22
VARIANT = "llvm_ad_rgb"


@dataclass(frozen=True)
class Cuboid:
    """Its middle, half of its sides, and degrees around y."""

    middle: tuple[float, float, float]
    half: tuple[float, float, float]
    degrees: float


@dataclass(frozen=True, kw_only=True)
class Traced:
    """Walls, their albedo (one, or (walls, 3) in colour), and where the pinhole is on the z axis.

    `tangent` is of half the frame, which walls fill; `roughness` above 0 coats the walls with a
    glossy layer.
    """

    about: str
    walls: Any
    albedo: Any
    tangent: float
    eye: float = 3.0
    blocks: tuple[Cuboid, ...] = ()
    roughness: float = 0.0

    @property
    def channels(self) -> int:
        """3 if the scene has colour, else 1."""
        return 1 if np.ndim(self.albedo) == 0 else 3

    def describe(self, mi: Any) -> dict[str, Any]:
        """The scene without light, for `mitsuba.load_dict`."""
        objects: dict[str, Any] = {"type": "scene"}
        for k, corners in enumerate(np.array(self.walls, np.float64)):
            objects[f"wall {k}"] = {
                "type": "rectangle",
                "to_world": wall_transform(mi, *corners),
                "bsdf": self.wall_surface(k),
            }
        for k, block in enumerate(self.blocks):
            place = mi.ScalarTransform4f().translate(list(block.middle))
            place = place.rotate([0, 1, 0], block.degrees).scale(list(block.half))
            surface = matt_surface(self.albedo)
            objects[f"block {k}"] = {"type": "cube", "to_world": place, "bsdf": surface}
        return objects

    def wall_surface(self, k: int) -> dict[str, Any]:
        """The surface of one wall, coated if it is rough."""
        colour = self.albedo if self.channels == 1 else list(self.albedo[k])
        surface = matt_surface(colour)
        if not self.roughness:
            return surface
        return {
            "type": "roughplastic",
            "diffuse_reflectance": surface["reflectance"],
            "alpha": self.roughness,
        }


def matt_surface(colour: Any) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}


def wall_transform(mi: Any, start: np.ndarray, right: np.ndarray, up: np.ndarray) -> Any:
    """Place Mitsuba's rectangle, [-1, 1] x [-1, 1], on a wall by its corner and edges."""
    middle = start + (right + up) / 2
    axes = np.transpose([right / 2, up / 2, np.cross(right, up), middle])
    return mi.ScalarTransform4f(np.vstack([axes, [0, 0, 0, 1]]))


# A wall that closes the box.
FRONT = ((0.5, -0.5, 1), (-1, 0, 0), (0, 1, 0))
BLOCKS = (
    Cuboid((-0.2, -0.2, 0.35), (0.14, 0.3, 0.14), 20.0),
    Cuboid((0.2, -0.35, 0.65), (0.15, 0.15, 0.15), -17.0),
)
PAINTS = ((0.8, 0.35, 0.3), (0.3, 0.65, 0.35), (0.7, 0.7, 0.75))
TRACED = {
    "corner": Traced(
        about="two white walls, albedo 0.7",
        walls=SCENES["dihedral"],
        albedo=0.7,
        tangent=0.1666,
    ),
    "coloured": Traced(
        about="three walls, red, green and white",
        walls=SCENES["trihedral"],
        albedo=PAINTS,
        tangent=0.226,
    ),
    "box": Traced(
        about="a box without its front, albedo 0.7",
        walls=SCENES["box"],
        albedo=0.7,
        tangent=0.2499,
    ),
    "blocks": Traced(
        about="a box without its front, two blocks in it, albedo 0.6",
        walls=SCENES["box"],
        albedo=0.6,
        tangent=0.2499,
        blocks=BLOCKS,
    ),
    "glossy": Traced(
        about="two walls, albedo 0.6 below a glossy coat",
        walls=SCENES["dihedral"],
        albedo=0.6,
        tangent=0.1666,
        roughness=0.2,
    ),
    "closed": Traced(
        about="a closed box, albedo 0.7, seen from a pinhole in it",
        walls=(*SCENES["box"], FRONT),
        albedo=0.7,
        tangent=1.0,
        eye=0.98,
    ),
}


def unavailable() -> str:
    """Why Mitsuba does not trace here, or an empty string; LLVM may end the process that tries."""
    command = [sys.executable, __file__]
    attempt = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    if attempt.returncode == 0:
        return ""
    lines = attempt.stderr.strip().splitlines() or [""]
    # The reason is in the last line of a traceback, in the first one of LLVM.
    reason = lines[-1] if attempt.returncode == 1 else lines[0]
    return f"Mitsuba's llvm_ad_rgb ended with {attempt.returncode}: {reason}"


def load_mitsuba() -> Any:
    """Mitsuba in the variant that renders here."""
    import mitsuba as mi

    mi.set_variant(VARIANT)
    return mi


def version() -> str:
    """Version of Mitsuba."""
    import mitsuba as mi

    return str(mi.__version__)


def trace(name: str, grid: tuple[int, int], paths: int, seed: int) -> np.ndarray:
    """T by bounces (`BOUNCES`, N, N) float32 of a scene of `TRACED`, in colour (`BOUNCES`, 3, N, N).

    Their sum is T. A camera pixel sends at least so many `paths`. Seeds give independent
    measurements.
    """
    tracer = PathTracer(TRACED[name], grid)
    pixels = tracer.pixels
    passes = math.ceil(paths * pixels / WAVEFRONT)
    # The sampler stratifies a square number of samples.
    side = math.ceil(math.sqrt(paths / passes))
    count = side**2
    random = np.random.default_rng(seed)
    for _ in range(passes):
        tracer.trace_pass(count, int(random.integers(1 << 31)))
    channels = tracer.scene.channels
    colours = () if channels == 1 else (channels,)
    T = np.array(tracer.T / (passes * count))
    return T.reshape(BOUNCES, *colours, pixels, pixels)


class PathTracer:
    """Accumulate samples of T by bounces over passes."""

    def __init__(self, scene: Traced, grid: tuple[int, int]) -> None:
        mi = load_mitsuba()
        import drjit as dr

        self.mi: Any = mi
        self.dr: Any = dr
        self.scene = scene
        self.grid = grid
        self.world = mi.load_dict(scene.describe(mi))
        self.eye = mi.Point3f(0.0, 0.0, scene.eye)
        self.context = mi.BSDFContext()
        # (BOUNCES, channels, N, N): sums of samples.
        self.T = dr.zeros(mi.Float, BOUNCES * scene.channels * self.pixels**2)

    @cached_property
    def pixels(self) -> int:
        """N, of the camera as of the projector."""
        return self.grid[0] * self.grid[1]

    def trace_pass(self, count: int, seed: int) -> None:
        """Send `count` paths from every camera pixel."""
        mi, dr = self.mi, self.dr
        sampler = self.make_sampler(count, seed)
        camera_pixel = dr.arange(mi.UInt32, self.pixels * count) // count
        ray = self.camera_rays(camera_pixel, sampler.next_2d())
        weight = mi.Color3f(1.0)
        active = mi.Bool(True)
        for depth in range(DEPTH):
            hit = self.world.ray_intersect(ray, active)
            active &= hit.is_valid()
            bsdf = hit.bsdf(ray)
            self.connect(hit, bsdf, weight, active, camera_pixel, depth)
            sample, share = bsdf.sample(
                self.context, hit, sampler.next_1d(), sampler.next_2d(), active
            )
            weight *= share
            if depth >= ROULETTE_DEPTH:
                survival = dr.minimum(dr.max(weight), MAX_SURVIVAL)
                active &= sampler.next_1d() < survival
                weight /= survival
            active &= dr.max(weight) > 0.0
            ray = hit.spawn_ray(hit.to_world(sample.wo))
            dr.eval(self.T, ray, weight, active)
            sampler.schedule_state()
            if not dr.any(active):
                break

    def make_sampler(self, count: int, seed: int) -> Any:
        """A sampler for a pass of `count` paths a pixel."""
        sampler = self.mi.load_dict({"type": "multijitter", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, self.pixels * count)
        return sampler

    def camera_rays(self, pixel: Any, within: Any) -> Any:
        """Rays through places within camera pixels, given in [0, 1]."""
        mi = self.mi
        h, w = self.grid
        tangent = self.scene.tangent
        x = (mi.Float(pixel % w) + within.x) / w
        y = (mi.Float(pixel // w) + within.y) / h
        direction = mi.Vector3f((2.0 * x - 1.0) * tangent, (1.0 - 2.0 * y) * tangent, -1.0)
        return mi.Ray3f(self.eye, self.dr.normalize(direction))

    def connect(
        self, hit: Any, bsdf: Any, weight: Any, active: Any, camera_pixel: Any, depth: int
    ) -> None:
        """Add to T the light of the projector that a vertex reflects towards its path."""
        dr = self.dr
        from_eye = hit.p - self.eye
        distance = -from_eye.z
        scale = distance * self.scene.tangent
        # The place in the projector's picture, in [0, 1].
        u = 0.5 + 0.5 * from_eye.x / scale
        v = 0.5 - 0.5 * from_eye.y / scale
        is_lit = active & (distance > 0.0) & (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
        is_lit &= ~self.world.ray_test(hit.spawn_ray_to(self.eye), is_lit)
        # The direct light of a pixel comes of its own: both are one pinhole.
        projector_pixel = camera_pixel if depth == 0 else self.pixel_at(u, v)
        towards_eye = hit.to_local(-dr.normalize(from_eye))
        value = weight * bsdf.eval(self.context, hit, towards_eye, is_lit)
        # Irradiance across the ray, of 1 at distance 1.
        value *= dr.norm(from_eye) / distance**3
        bounce = min(depth, BOUNCES - 1)
        for channel in range(self.scene.channels):
            block = bounce * self.scene.channels + channel
            place = (block * self.pixels + camera_pixel) * self.pixels + projector_pixel
            dr.scatter_reduce(dr.ReduceOp.Add, self.T, value[channel], place, is_lit)

    def pixel_at(self, u: Any, v: Any) -> Any:
        """The pixel at a place in [0, 1) x [0, 1)."""
        mi, dr = self.mi, self.dr
        h, w = self.grid
        row = dr.minimum(mi.UInt32(v * h), h - 1)
        column = dr.minimum(mi.UInt32(u * w), w - 1)
        return row * w + column


def photographs(name: str, patterns: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """Pictures of the scene under each of the patterns, (K, h, w) or (K, h, w, 3) in [0, 1], of its shape.

    Rendered by Mitsuba's path integrator and projector emitter. In a scene without colour three
    patterns are rendered at once, as red, green and blue.
    """
    mi = load_mitsuba()
    traced = TRACED[name]
    count, h, w = patterns.shape[:3]
    if traced.channels == 1:
        patterns = join_as_colours(patterns)
    pinhole = describe_pinhole(mi, traced)
    scene = traced.describe(mi)
    scene["sensor"] = describe_sensor(pinhole, (h, w), samples)
    scene["integrator"] = {"type": "path", "max_depth": DEPTH + 1}
    pictures = []
    for k, pattern in enumerate(patterns):
        projector = describe_projector(mi, pinhole, pattern)
        world = mi.load_dict(scene | {"projector": projector})
        picture_seed = mi.UInt32(seed * len(patterns) + k)
        pictures.append(np.array(mi.render(world, spp=samples, seed=picture_seed)))
    image = np.stack(pictures)
    if traced.channels == 3:
        return image
    return np.moveaxis(image, -1, 1).reshape(-1, h, w)[:count]


def join_as_colours(patterns: np.ndarray) -> np.ndarray:
    """Patterns (K, h, w) by threes as red, green and blue, (ceil(K / 3), h, w, 3)."""
    count, h, w = patterns.shape
    pictures = math.ceil(count / 3)
    filled = np.zeros((3 * pictures, h, w), np.float32)
    filled[:count] = patterns
    return np.moveaxis(filled.reshape(-1, 3, h, w), 1, -1)


def describe_pinhole(mi: Any, traced: Traced) -> dict[str, Any]:
    """Place and field of view of camera and projector."""
    origin = [0, 0, traced.eye]
    return {
        "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0]),
        "fov": math.degrees(2 * math.atan(traced.tangent)),
        "fov_axis": "x",
    }


def describe_sensor(pinhole: dict[str, Any], grid: tuple[int, int], samples: int) -> dict[str, Any]:
    film = {
        "type": "hdrfilm",
        "component_format": "float32",
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "height": grid[0],
        "width": grid[1],
    }
    return {
        "type": "perspective",
        **pinhole,
        "film": film,
        "near_clip": 1e-3,
        "sampler": {"type": "multijitter", "sample_count": samples},
    }


def describe_projector(mi: Any, pinhole: dict[str, Any], pattern: np.ndarray) -> dict[str, Any]:
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(pattern, np.float32)),
        "raw": True,
        "filter_type": "nearest",
        "wrap_mode": "clamp",
    }
    return {"type": "projector", **pinhole, "irradiance": texture, "scale": 1.0 / math.pi}


if __name__ == "__main__":
    trace("box", (2, 2), 4, 0)
