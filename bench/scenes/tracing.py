# SPDX-License-Identifier: BSD-3-Clause
"""T of a scene by bounces, and photographs of it, of an independent renderer: Mitsuba 3 traces.

Nothing here uses an inverse. Paths of `trace` begin in a camera pixel i. Every vertex is connected
to the projector, whose pixel j shines there: what it reflects towards the path is a sample of T[i,
j], of the bounce that the vertex is. So one pass yields whole rows. `photographs` are Mitsuba's
own, by its path integrator and its projector. Camera and projector are one pinhole; pixel j of the
projector gives irradiance 1 on a plane at distance 1. Mitsuba's wavefronts need LLVM: `unavailable`
says why they do not run.
"""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl.acquisition.rigs.mitsuba import SCENES

BOUNCES = 5  # direct light, bounces 1 to 3, and all further ones
_DEPTH = 64  # vertices of a path
_SIZE, _SURE = 1 << 22, 4  # paths at once; vertices before Russian roulette
_VARIANT = "llvm_ad_rgb"
# Middle, half of the sides, and degrees around y.
_BLOCKS = (
    ((-0.2, -0.2, 0.35), (0.14, 0.3, 0.14), 20.0),
    ((0.2, -0.35, 0.65), (0.15, 0.15, 0.15), -17.0),
)
_FRONT = ((0.5, -0.5, 1), (-1, 0, 0), (0, 1, 0))  # closes the box


@dataclass(frozen=True)
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
    blocks: tuple[Any, ...] = ()
    roughness: float = 0.0

    @property
    def channels(self) -> int:
        """3 where the scene has colour."""
        return 1 if np.ndim(self.albedo) == 0 else 3

    def describe(self, mi: Any) -> dict[str, Any]:
        """The scene without light, for `mitsuba.load_dict`."""

        def matt(colour: Any) -> dict[str, Any]:
            return {"type": "diffuse", "reflectance": {"type": "rgb", "value": colour}}

        described: dict[str, Any] = {"type": "scene"}
        for k, (start, right, up) in enumerate(np.array(self.walls, np.float64)):
            axes = right / 2, up / 2, np.cross(right, up), start + (right + up) / 2
            colour = self.albedo if self.channels == 1 else list(self.albedo[k])
            surface = matt(colour)
            if self.roughness:
                layer = {"diffuse_reflectance": surface["reflectance"], "alpha": self.roughness}
                surface = {"type": "roughplastic", **layer}
            place = mi.ScalarTransform4f(np.vstack([np.transpose(axes), [0, 0, 0, 1]]))
            described[f"wall {k}"] = {"type": "rectangle", "to_world": place, "bsdf": surface}
        for k, (middle, half, degrees) in enumerate(self.blocks):
            place = mi.ScalarTransform4f().translate(list(middle)).rotate([0, 1, 0], degrees)
            cube = {"type": "cube", "to_world": place.scale(list(half)), "bsdf": matt(self.albedo)}
            described[f"block {k}"] = cube
        return described


_PAINTS = (0.8, 0.35, 0.3), (0.3, 0.65, 0.35), (0.7, 0.7, 0.75)
TRACED = {
    "corner": Traced("two white walls, albedo 0.7", SCENES["dihedral"], 0.7, 0.1666),
    "coloured": Traced("three walls, red, green and white", SCENES["trihedral"], _PAINTS, 0.226),
    "box": Traced("a box without its front, albedo 0.7", SCENES["box"], 0.7, 0.2499),
    "blocks": Traced(
        "a box without its front, two blocks in it, albedo 0.6",
        SCENES["box"],
        0.6,
        0.2499,
        blocks=_BLOCKS,
    ),
    "glossy": Traced(
        "two walls, albedo 0.6 below a glossy coat", SCENES["dihedral"], 0.6, 0.1666, roughness=0.2
    ),
    "closed": Traced(
        "a closed box, albedo 0.7, seen from a pinhole in it",
        (*SCENES["box"], _FRONT),
        0.7,
        1.0,
        eye=0.98,
    ),
}


def unavailable() -> str:
    """Why Mitsuba does not trace here, or nothing; tried in a process of its own, which LLVM may end."""
    tried = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=False)  # noqa: S603
    lines = tried.stderr.strip().splitlines() or [""]
    why = lines[-1 if tried.returncode == 1 else 0]  # of a traceback the last, of LLVM the first
    return f"Mitsuba's llvm_ad_rgb ended with {tried.returncode}: {why}" if tried.returncode else ""


def version() -> str:
    """Of Mitsuba."""
    import mitsuba as mi

    return str(mi.__version__)


def trace(name: str, grid: tuple[int, int], paths: int, seed: int) -> np.ndarray:
    """T by bounces (`BOUNCES`, N, N) float32 of a scene of `TRACED`, in colour (`BOUNCES`, 3, N, N).

    Their sum is T. A camera pixel sends at least so many `paths`. Seeds give independent
    measurements.
    """
    import mitsuba as mi

    mi.set_variant(_VARIANT)
    import drjit as dr

    traced = TRACED[name]
    tangent, channels = traced.tangent, traced.channels
    world, (h, w), n = mi.load_dict(traced.describe(mi)), grid, grid[0] * grid[1]
    T = dr.zeros(mi.Float, BOUNCES * channels * n * n)
    eye, context, random = (
        mi.Point3f(0.0, 0.0, traced.eye),
        mi.BSDFContext(),
        np.random.default_rng(seed),
    )
    passes = -(-paths * n // _SIZE)
    count = math.ceil(math.sqrt(paths / passes)) ** 2
    for _ in range(passes):
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(int(random.integers(1 << 31)), n * count)
        number = dr.arange(mi.UInt32, n * count)
        i = number // count
        within = sampler.next_2d()
        x, y = (mi.Float(i % w) + within.x) / w, (mi.Float(i // w) + within.y) / h
        towards = mi.Vector3f((2.0 * x - 1.0) * tangent, (1.0 - 2.0 * y) * tangent, -1.0)
        ray, weight, active = mi.Ray3f(eye, dr.normalize(towards)), mi.Color3f(1.0), mi.Bool(True)
        for k in range(_DEPTH):
            hit = world.ray_intersect(ray, active)
            active &= hit.is_valid()
            bsdf, ways = hit.bsdf(ray), hit.p - eye
            far = -ways.z
            u, v = 0.5 + 0.5 * ways.x / (far * tangent), 0.5 - 0.5 * ways.y / (far * tangent)
            lit = active & (far > 0.0) & (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
            lit &= ~world.ray_test(hit.spawn_ray_to(eye), lit)
            j = (
                i
                if k == 0
                else dr.minimum(mi.UInt32(v * h), h - 1) * w + dr.minimum(mi.UInt32(u * w), w - 1)
            )
            value = weight * bsdf.eval(context, hit, hit.to_local(-dr.normalize(ways)), lit)
            value *= dr.norm(ways) / far**3  # irradiance across the ray, of 1 at distance 1
            for channel in range(channels):
                at = ((min(k, BOUNCES - 1) * channels + channel) * n + i) * n + j
                dr.scatter_reduce(dr.ReduceOp.Add, T, value[channel], at, lit)
            sample, share = bsdf.sample(context, hit, sampler.next_1d(), sampler.next_2d(), active)
            weight *= share
            if k >= _SURE:
                survives = dr.minimum(dr.max(weight), 0.95)
                active &= sampler.next_1d() < survives
                weight /= survives
            active &= dr.max(weight) > 0.0
            ray = hit.spawn_ray(hit.to_world(sample.wo))
            dr.eval(T, ray, weight, active)
            sampler.schedule_state()
            if not dr.any(active):
                break
    colours = () if channels == 1 else (channels,)
    return np.array(T / (passes * count)).reshape(BOUNCES, *colours, n, n)


def photographs(name: str, patterns: np.ndarray, samples: int, seed: int) -> np.ndarray:
    """Pictures of the scene under each of the patterns, (K, h, w) or (K, h, w, 3) in [0, 1], of its shape.

    Rendered by Mitsuba's path integrator and projector emitter. In a scene without colour three
    patterns are rendered at once, as red, green and blue.
    """
    import mitsuba as mi

    mi.set_variant(_VARIANT)
    traced, (count, h, w) = TRACED[name], patterns.shape[:3]
    if traced.channels == 1:
        filled = np.zeros((-(-count // 3) * 3, h, w), np.float32)
        filled[:count] = patterns
        patterns = np.moveaxis(filled.reshape(-1, 3, h, w), 1, -1)
    there = mi.ScalarTransform4f().look_at(
        origin=[0, 0, traced.eye], target=[0, 0, 0], up=[0, 1, 0]
    )
    pinhole = {
        "to_world": there,
        "fov": math.degrees(2 * math.atan(traced.tangent)),
        "fov_axis": "x",
    }
    film = {
        "type": "hdrfilm",
        "component_format": "float32",
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }
    film |= {"height": h, "width": w}
    sensor = {"type": "perspective", **pinhole, "film": film, "near_clip": 1e-3}
    sensor["sampler"] = {"type": "multijitter", "sample_count": samples}
    integrator = {"type": "path", "max_depth": _DEPTH + 1}
    pictures = []
    for k, pattern in enumerate(patterns):
        bitmap = mi.Bitmap(np.ascontiguousarray(pattern, np.float32))
        texture = {"type": "bitmap", "bitmap": bitmap, "raw": True}
        texture |= {"filter_type": "nearest", "wrap_mode": "clamp"}
        projector = {"type": "projector", **pinhole, "irradiance": texture, "scale": 1.0 / math.pi}
        lit = {"projector": projector, "sensor": sensor}
        scene = mi.load_dict(traced.describe(mi) | lit | {"integrator": integrator})
        pictures.append(
            np.array(mi.render(scene, spp=samples, seed=mi.UInt32(seed * len(patterns) + k)))
        )
    image = np.stack(pictures)
    return image if traced.channels == 3 else np.moveaxis(image, -1, 1).reshape(-1, h, w)[:count]


if __name__ == "__main__":
    trace("box", (2, 2), 4, 0)
