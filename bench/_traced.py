# SPDX-License-Identifier: BSD-3-Clause
"""T of a scene by bounces, of an independent renderer: Mitsuba 3 traces, nothing here uses an inverse.

Paths begin in a camera pixel i. Every vertex is connected to the projector, whose pixel j shines there: what
it reflects towards the path is a sample of T[i, j], of the bounce that the vertex is. So one pass yields
whole rows. Camera and projector are one pinhole; pixel j of the projector gives irradiance 1 on a plane
at distance 1. Mitsuba's wavefronts need LLVM: `unavailable` says why they do not run.
"""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import numpy as np

from ltcl.acquisition.rigs.mitsuba import SCENES

BOUNCES = 5  # direct light, bounces 1 to 3, and all further ones
_EYE, _DEPTH = 3.0, 64  # place on the z axis; vertices
_SIZE, _SURE = 1 << 22, 4  # paths at once; vertices before Russian roulette
# Middle, half of the sides, and degrees around y.
_BLOCKS = ((-0.2, -0.2, 0.35), (0.14, 0.3, 0.14), 20.0), ((0.2, -0.35, 0.65), (0.15, 0.15, 0.15), -17.0)
# Walls, their albedo, blocks among them, tangent of half the frame.
TRACED = {
    "corner": ("dihedral", 0.7, (), 0.1666),
    "box": ("box", 0.7, (), 0.2499),
    "blocks": ("box", 0.6, _BLOCKS, 0.2499),
}


def unavailable() -> str:
    """Why Mitsuba does not trace here, or nothing; tried in a process of its own, which LLVM may end."""
    tried = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=False)  # noqa: S603
    lines = tried.stderr.strip().splitlines() or [""]
    why = lines[-1 if tried.returncode == 1 else 0]  # of a traceback the last, of LLVM the first
    return f"Mitsuba's llvm_ad_rgb ended with {tried.returncode}: {why}" if tried.returncode else ""


def trace(name: str, grid: tuple[int, int], paths: int, seed: int) -> np.ndarray:
    """T by bounces (`BOUNCES`, N, N) float32 of a scene of `TRACED`; their sum is T.

    A camera pixel sends at least so many `paths`. Seeds give independent measurements.
    """
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    import drjit as dr

    walls, albedo, blocks, tangent = TRACED[name]
    matt = {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}
    described: dict[str, Any] = {"type": "scene"}
    for k, (start, right, up) in enumerate(np.array(SCENES[walls], np.float64)):
        axes = right / 2, up / 2, np.cross(right, up), start + (right + up) / 2
        place = mi.ScalarTransform4f(np.vstack([np.transpose(axes), [0, 0, 0, 1]]))
        described[f"wall {k}"] = {"type": "rectangle", "to_world": place, "bsdf": matt}
    for k, (middle, half, degrees) in enumerate(blocks):
        place = mi.ScalarTransform4f().translate(list(middle)).rotate([0, 1, 0], degrees).scale(list(half))
        described[f"block {k}"] = {"type": "cube", "to_world": place, "bsdf": matt}
    world, (h, w), n = mi.load_dict(described), grid, grid[0] * grid[1]
    T = dr.zeros(mi.Float, BOUNCES * n * n)
    eye, context, random = mi.Point3f(0.0, 0.0, _EYE), mi.BSDFContext(), np.random.default_rng(seed)
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
            j = i if k == 0 else dr.minimum(mi.UInt32(v * h), h - 1) * w + dr.minimum(mi.UInt32(u * w), w - 1)
            value = weight * bsdf.eval(context, hit, hit.to_local(-dr.normalize(ways)), lit)
            value *= dr.norm(ways) / far**3  # irradiance across the ray, of 1 at distance 1
            at = (mi.UInt32(min(k, BOUNCES - 1)) * n + i) * n + j
            dr.scatter_reduce(dr.ReduceOp.Add, T, value[1], at, lit)  # all walls are grey
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
    return np.array(T / (passes * count)).reshape(BOUNCES, n, n)


if __name__ == "__main__":
    trace("box", (2, 2), 4, 0)
