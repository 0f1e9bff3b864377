# SPDX-License-Identifier: BSD-3-Clause
"""Video: frames a second from decoded sRGB codes to the codes of the projector, in colour.

T has 256 x 512 pixels and is as `ltcl.compress` makes it of a smooth scene: db2 wavelets on both
sides, with a core of some thousand coarse coefficients, ten numbers a row. Frames drift slowly and
are compensated one by one, and by eights as `ltcl.batch.compensate_frames` does, which is timed
with its pictures on disk.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy.sparse

import _coefficients
import ltcl
from _harness import Options, Row, parse_options, report, seconds
from ltcl import Transport
from ltcl.images import from_srgb, to_srgb
from ltcl.operators import Compressed, Wavelet
from ltcl.scenes import landscape

ALBEDO = (0.4, 0.3, 0.2)
# Numbers of the core a row.
ROW_NUMBERS = 10
RTOL = 1e-2
BATCH = 8
# Frames a second with solves, and with a kept inverse.
SOLVE_TARGET = 60.0
INVERSE_TARGET = 120.0
# Light of each code, and the code of each of LIGHT_STEPS + 1 levels of light between 0 and 1.
TO_LINEAR = from_srgb(np.arange(256, dtype=np.float32) / 255)
LIGHT_STEPS = 4095


def to_codes(light: np.ndarray) -> np.ndarray:
    """The nearest 8-bit codes of light in [0, 1]."""
    return np.rint(255 * to_srgb(light)).astype(np.uint8)


TO_CODES = to_codes(np.linspace(0, 1, LIGHT_STEPS + 1, dtype=np.float32))


def transport(options: Options, grid: tuple[int, int], coarse: tuple[int, int]) -> Transport:
    """T = (I + R) F with R symmetric in the `coarse` wavelet coefficients.

    The norm of R is m / (1 - m) at most.
    """
    W = Wavelet(options.device, grid, "db2")
    core = symmetric_core(grid, coarse)
    cores = []
    for albedo in ALBEDO:
        scale = albedo / (1.0 - albedo)
        cores.append((core * scale).astype(np.float32))
    return _coefficients.transport(W, cores, ALBEDO)


def symmetric_core(grid: tuple[int, int], coarse: tuple[int, int]) -> Any:
    """Random numbers between near coarse coefficients, with row sums of 1 at most."""
    random = np.random.default_rng(0)
    n = grid[0] * grid[1]
    places = np.arange(coarse[0])[:, None] * grid[1] + np.arange(coarse[1])
    places = places.ravel()
    rows = np.repeat(np.arange(len(places)), ROW_NUMBERS // 2)
    shifts = random.integers(-4 * ROW_NUMBERS, 4 * ROW_NUMBERS, rows.size)
    columns = (rows + shifts) % len(places)
    numbers = random.uniform(0.0, 1.0, rows.size)
    place = (places[rows], places[columns])
    half = scipy.sparse.csr_array((numbers, place), shape=(n, n))
    core = scipy.sparse.csr_array(half + half.T)
    core *= 1.0 / abs(core).sum(axis=1).max()
    return core


def film(T: Transport, frames: int) -> np.ndarray:
    """A landscape that drifts, in codes, (frames, h, w, 3) uint8, within the projector's reach."""
    h, w = T.grid
    picture = np.asarray(landscape(h, w), np.float32).reshape(h, w, -1)[..., :3]
    light = np.broadcast_to(0.1 + 0.2 * picture, (h, w, 3))
    codes = to_codes(light)
    return np.stack([np.roll(codes, 2 * k, axis=1) for k in range(frames)])


def projector_codes(T: Transport, codes: np.ndarray, **settings: Any) -> np.ndarray:
    """The projector's codes under which the scene looks like these."""
    rules = {"rtol": RTOL, "clamp": True, **settings}
    compensation = ltcl.compensate(T, TO_LINEAR[codes], **rules)
    levels = (LIGHT_STEPS * compensation.pattern + 0.5).astype(np.int16)
    return TO_CODES[levels]


def measure(
    options: Options, T: Transport, inverse: ltcl.Inverse, frames: np.ndarray
) -> dict[str, float]:
    """Seconds of BATCH frames, in all ways."""

    def run_each(**settings: Any) -> None:
        for codes in frames:
            projector_codes(T, codes, **settings)

    def run_files(folder: Path, **settings: Any) -> None:
        rules: Any = {"batch": BATCH, "rtol": RTOL, "clamp": True, **settings}
        with tempfile.TemporaryDirectory() as out:
            ltcl.batch.compensate_frames(T, folder, out, **rules)

    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "film"
        for number, codes in enumerate(frames):
            ltcl.images.write(folder / f"{number}.png", TO_LINEAR[codes])
        actions: dict[str, Callable[[], object]] = {
            "solves, one by one": run_each,
            "solves, 8 at a time": lambda: projector_codes(T, frames),
            "inverse, one by one": lambda: run_each(inverse=inverse),
            "inverse, 8 at a time": lambda: projector_codes(T, frames, inverse=inverse),
            "solves, compensate_frames, .png to .png": lambda: run_files(folder),
            "inverse, compensate_frames, .png to .png": lambda: run_files(folder, inverse=inverse),
        }
        return seconds(actions, 1 if options.smoke else 7)


def rate_row(name: str, spent: float) -> Row:
    rate = BATCH / spent
    target = INVERSE_TARGET if name.startswith("inverse") else SOLVE_TARGET
    ratio = rate / target
    least: float | None = 1.0
    if "png" in name:
        # Files take as long as the machine's disk.
        least = None
    return Row(name, f"{target:g} frames/s", target, rate, "frames/s", ratio, least)


def frame_facts(T: Transport) -> dict[str, Any]:
    """Method, products and error of one frame."""
    (codes,) = film(T, 1)
    compensation = ltcl.compensate(T, TO_LINEAR[codes], rtol=RTOL, clamp=True)
    solutions = compensation.solution
    if not isinstance(solutions, tuple):
        solutions = (solutions,)
    return {
        "method": solutions[0].method,
        "products of a channel": max(solution.products for solution in solutions),
        "error of a frame": compensation.error,
        "clipped": compensation.clipped,
    }


def main() -> None:
    options = parse_options(__doc__)
    grid, coarse = ((16, 32), (4, 8)) if options.smoke else ((256, 512), (32, 64))
    T = transport(options, grid, coarse)
    inverse = ltcl.invert(T, RTOL)
    times = measure(options, T, inverse, film(T, BATCH))
    rows = [rate_row(name, spent) for name, spent in times.items()]
    R = cast(Compressed, T.systems[0].R)
    facts = {
        "pixels": grid[0] * grid[1],
        "coefficients of the core": R.core.shape[0],
        **frame_facts(T),
        "error of the inverse, bound": inverse.error,
    }
    report(options, "Video, 256 x 512 in colour", rows, facts)


if __name__ == "__main__":
    main()
