# SPDX-License-Identifier: BSD-3-Clause
"""Video: frames a second from decoded sRGB codes to the 8-bit codes of the projector, 256 x 512 in colour.

T is as `ltcl.compress` makes it of a smooth scene: db2 wavelets on both sides, with a core of some
thousand coarse coefficients, ten numbers a row. Frames drift slowly and are compensated one by one,
and by eights as `ltcl.batch.compensate_frames` does, which is timed with its pictures on disk.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy.sparse

import _coefficients
import ltcl
from _harness import Options, Row, parse_options, report, seconds
from ltcl.operators import Compressed, Wavelet
from ltcl.scenes import landscape

ALBEDO = (0.4, 0.3, 0.2)
NUMBERS, RTOL, BATCH = 10, 1e-2, 8
SOLVES, KEPT = 60.0, 120.0  # frames a second
TO_LINEAR = ltcl.images.from_srgb(np.arange(256, dtype=np.float32) / 255)
STEPS = 4095  # of light between 0 and 1, of which each has a code
TO_CODES = np.rint(
    255 * ltcl.images.to_srgb(np.linspace(0, 1, STEPS + 1, dtype=np.float32))
).astype(np.uint8)


def transport(given: Options, grid: tuple[int, int], coarse: tuple[int, int]) -> ltcl.Transport:
    """T = (I + R) F with R symmetric in the `coarse` wavelet coefficients and of norm m / (1 - m) at most."""
    rng, W = np.random.default_rng(0), Wavelet(given.device, grid, "db2")
    n = grid[0] * grid[1]
    places = (np.arange(coarse[0])[:, None] * grid[1] + np.arange(coarse[1])).ravel()
    rows = np.repeat(np.arange(len(places)), NUMBERS // 2)
    columns = (rows + rng.integers(-4 * NUMBERS, 4 * NUMBERS, rows.size)) % len(places)
    numbers = rng.uniform(0.0, 1.0, rows.size)
    half = scipy.sparse.csr_array((numbers, (places[rows], places[columns])), shape=(n, n))
    core = scipy.sparse.csr_array(half + half.T)
    core *= 1.0 / abs(core).sum(axis=1).max()
    cores = [(core * (m / (1.0 - m))).astype(np.float32) for m in ALBEDO]
    return _coefficients.transport(W, cores, ALBEDO)


def film(T: ltcl.Transport, frames: int) -> np.ndarray:
    """Decoded frames, (frames, h, w, 3) uint8: a landscape that drifts, within reach of the projector."""
    h, w = T.grid
    light = 0.1 + 0.2 * np.asarray(landscape(h, w), np.float32).reshape(h, w, -1)[..., :3]
    codes = np.rint(255 * ltcl.images.to_srgb(np.broadcast_to(light, (h, w, 3)))).astype(np.uint8)
    return np.stack([np.roll(codes, 2 * k, axis=1) for k in range(frames)])


def shown(T: ltcl.Transport, codes: np.ndarray, **settings: Any) -> np.ndarray:
    """The projector's codes under which the scene shows these."""
    done = ltcl.compensate(T, TO_LINEAR[codes], rtol=RTOL, clamp=True, **settings)
    return TO_CODES[(STEPS * done.pattern + 0.5).astype(np.int16)]


def main() -> None:
    given = parse_options(__doc__ or "")
    grid, coarse = ((16, 32), (4, 8)) if given.smoke else ((256, 512), (32, 64))
    T = transport(given, grid, coarse)
    inverse, frames = ltcl.invert(T, RTOL), film(T, BATCH)
    kept = {"inverse": inverse}
    with tempfile.TemporaryDirectory() as folder:
        for number, codes in enumerate(frames):
            ltcl.images.write(Path(folder) / "film" / f"{number}.png", TO_LINEAR[codes])

        def files(**settings: Any) -> None:
            with tempfile.TemporaryDirectory() as out:
                rules: Any = {"batch": BATCH, "rtol": RTOL, "clamp": True, **settings}
                ltcl.batch.compensate_frames(T, Path(folder) / "film", out, **rules)

        actions = {
            "solves, one by one": lambda: [shown(T, codes) for codes in frames],
            "solves, 8 at a time": lambda: shown(T, frames),
            "inverse, one by one": lambda: [shown(T, codes, **kept) for codes in frames],
            "inverse, 8 at a time": lambda: shown(T, frames, **kept),
            "solves, compensate_frames, .png to .png": files,
            "inverse, compensate_frames, .png to .png": lambda: files(**kept),
        }
        spent = seconds(actions, 1 if given.smoke else 7)
    rows = []
    for name, time in spent.items():
        rate, target = BATCH / time, KEPT if name.startswith("inverse") else SOLVES
        goal = None if "png" in name else 1.0
        rows.append(
            Row(name, f"{target:g} frames/s", target, rate, "frames/s", rate / target, goal)
        )
    done = ltcl.compensate(T, TO_LINEAR[film(T, 1)[0]], rtol=RTOL, clamp=True)
    solutions = done.solution if isinstance(done.solution, tuple) else (done.solution,)
    facts = {
        "pixels": grid[0] * grid[1],
        "coefficients of the core": cast(Compressed, T.systems[0].R).core.shape[0],
        "method": solutions[0].method,
        "products of a channel": max(one.products for one in solutions),
        "error of a frame": done.error,
        "clipped": done.clipped,
        "error of the inverse, bound": inverse.error,
    }
    report(given, "Video, 256 x 512 in colour", rows, facts)


if __name__ == "__main__":
    main()
