# SPDX-License-Identifier: BSD-3-Clause
"""Video: frames a second from decoded sRGB codes to the codes of the projector.

T has 256 x 512 pixels and is as `ltcl.compress` makes it of a smooth scene: db2 wavelets on both
sides, with a core of some thousand coarse coefficients, ten numbers a row. Frames drift slowly and
go through an `ltcl.Compensator`, with a kept inverse or with solves, one by one and pipelined, in
colour and in grey; beside it by `ltcl.compensate`, one by one and by eights. The host's thread is
timed while it queues. Films on disk go through `ltcl.batch.compensate_frames`, beside what reading
and writing the same files alone takes on two threads: the same patterns, of 16 bits.

A T of 1080 x 1920 pixels in colour has a direct part, and a smooth one that bounces between cells
of 8 x 8 pixels; also with the light of bounces computed of every second frame, whose rate is that
of pairs of frames. What a sketch makes of textured walls has a core of more numbers:
`sketch_large.py` tells the rate with it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy.sparse

import _coefficients
import ltcl
from _harness import Options, Row, parse_options, report, seconds
from ltcl import Transport
from ltcl.images import from_srgb, to_srgb
from ltcl.images.frames import open_frames, write_video
from ltcl.operators import Compressed, IdentityPlus, ScaledColumns, Wavelet
from ltcl.scenes import landscape

ALBEDO = (0.4, 0.3, 0.2)
# Numbers of the core a row.
ROW_NUMBERS = 10
RTOL = 1e-2
BATCH = 8
# Frames of a measurement, one by one, and of a pipeline.
FRAMES = 200
# Light of each code, and the code of each of LIGHT_STEPS + 1 levels of light between 0 and 1.
TO_LINEAR = from_srgb(np.arange(256, dtype=np.float32) / 255)
LIGHT_STEPS = 4095
READER = "import sys\nwhile sys.stdin.buffer.read(1 << 20):\n    pass"


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


def one_channel(T: Transport) -> Transport:
    """The first channel of T, as a grey T."""
    return Transport(T.matrices[0], T.grid, first_bounce=np.atleast_2d(T.first_bounce)[0])


def film(T: Transport, frames: int) -> np.ndarray:
    """A landscape that drifts, in codes, (frames, h, w, 3) uint8, within the projector's reach."""
    h, w = T.grid
    picture = np.asarray(landscape(h, w), np.float32).reshape(h, w, -1)[..., :3]
    light = np.broadcast_to(0.1 + 0.2 * picture, (h, w, 3))
    codes = to_codes(light)
    return np.stack([np.roll(codes, 2 * k, axis=1) for k in range(frames)])


def projector_codes(T: Transport, codes: np.ndarray, **settings: Any) -> np.ndarray:
    """The projector's codes under which the scene looks like these, by `compensate`."""
    rules = {"rtol": RTOL, "clamp": True, **settings}
    compensation = ltcl.compensate(T, TO_LINEAR[codes], **rules)
    levels = (LIGHT_STEPS * compensation.pattern + 0.5).astype(np.int16)
    return TO_CODES[levels]


# Prepared frames.


def cycle(frames: np.ndarray, count: int) -> Iterator[np.ndarray]:
    for number in range(count):
        yield frames[number % len(frames)]


def one_by_one(
    T: Transport, frames: np.ndarray, count: int, *, period: int = 1, **settings: Any
) -> dict[str, float]:
    """Frames a second, the 99th percentile in seconds, and what the host's thread takes.

    Of every `period` frames the first may take longer: their mean counts.
    """
    with ltcl.Compensator(T, rtol=RTOL, clamp=True, **settings) as compensator:
        for codes in cycle(frames, 10 * period):
            compensator(codes)
        latencies = []
        for codes in cycle(frames, count):
            start = time.perf_counter()
            compensator(codes)
            latencies.append(time.perf_counter() - start)
        host = host_seconds(compensator, frames, count)
    periods = np.reshape(latencies, (-1, period)).mean(axis=1)
    return {
        "rate": 1.0 / float(np.median(periods)),
        "p99": float(np.quantile(latencies, 0.99)),
        "host": host,
    }


def host_seconds(compensator: ltcl.Compensator, frames: np.ndarray, count: int) -> float:
    """What the thread that submits a frame takes of the processor, the median."""
    spent = []
    for codes in cycle(frames, count):
        start = time.thread_time()
        future = compensator.submit(codes)
        spent.append(time.thread_time() - start)
        future.result()
    return float(np.median(spent))


def pipelined(T: Transport, frames: np.ndarray, count: int, **settings: Any) -> float:
    """Frames a second, where the next ones are submitted before one has come."""
    with ltcl.Compensator(T, rtol=RTOL, clamp=True, **settings) as compensator:
        for codes in cycle(frames, 10):
            compensator(codes)
        start = time.perf_counter()
        futures = [compensator.submit(codes) for codes in cycle(frames, count)]
        for future in futures:
            future.result()
        return count / (time.perf_counter() - start)


def prepared_rows(
    options: Options, T: Transport, inverse: ltcl.Inverse, frames: np.ndarray
) -> list[Row]:
    """Rates of prepared frames against what is asked."""
    count = 8 if options.smoke else FRAMES
    grey_T = one_channel(T)
    grey_inverse = ltcl.invert(grey_T, RTOL)
    grey = np.ascontiguousarray(frames[..., 0])
    kinds = [
        ("colour, kept inverse", T, frames, {"inverse": inverse}, 240.0, 300.0),
        ("colour, solves", T, frames, {}, 120.0, 150.0),
        ("grey, kept inverse", grey_T, grey, {"inverse": grey_inverse}, 600.0, 600.0),
    ]
    rows = []
    for name, kind_T, kind_frames, settings, asked, asked_pipelined in kinds:
        times = one_by_one(kind_T, kind_frames, count, **settings)
        rate = pipelined(kind_T, kind_frames, count, **settings)
        rows.append(rate_row(f"{name}: one by one", times["rate"], asked))
        rows.append(rate_row(f"{name}: pipelined", rate, asked_pipelined))
        rows.append(time_row(f"{name}: 99 % of frames within", times["p99"], 6e-3))
        rows.append(time_row(f"{name}: the host's thread", times["host"], 1e-3))
    return rows


def rate_row(name: str, rate: float, asked: float) -> Row:
    return Row(name, f"{asked:g} frames/s", asked, rate, "frames/s", rate / asked, 1.0)


def time_row(name: str, spent: float, asked: float) -> Row:
    return Row.from_times(name, f"{1e3 * asked:g} ms", 1e3 * asked, 1e3 * spent, "ms", 1.0)


# By `compensate`.


def compensate_rows(
    options: Options, T: Transport, inverse: ltcl.Inverse, frames: np.ndarray
) -> list[Row]:
    """A solve and a compensation of one frame, and eight frames at a time."""
    light = TO_LINEAR[frames[0]]
    sides = [light[..., channel].ravel() for channel in range(3)]
    actions: dict[str, Callable[[], object]] = {
        "solve": lambda: ltcl.solvers.solve_each(T.systems, sides, rtol=RTOL),
        "compensate": lambda: ltcl.compensate(T, light, rtol=RTOL, clamp=True),
        "solves": lambda: projector_codes(T, frames),
        "inverse": lambda: projector_codes(T, frames, inverse=inverse),
    }
    times = seconds(actions, 1 if options.smoke else 7)
    return [
        time_row("131 072 pixels in colour, 1 %: solve", times["solve"], 5e-3),
        time_row("131 072 pixels in colour, 1 %: compensate", times["compensate"], 10e-3),
        fact_row("compensate, 8 frames at once, solves", len(frames) / times["solves"]),
        fact_row("compensate, 8 frames at once, kept inverse", len(frames) / times["inverse"]),
    ]


def fact_row(name: str, rate: float) -> Row:
    return Row(name, "", rate, rate, "frames/s", 1.0)


# Films.


def film_rows(
    options: Options, T: Transport, inverse: ltcl.Inverse, frames: np.ndarray
) -> list[Row]:
    """Films on disk against reading and writing them alone, by two threads."""
    count = 2 if options.smoke else 48
    with tempfile.TemporaryDirectory() as parent, pipe() as out:
        folder = Path(parent) / "film"
        for number, codes in enumerate(cycle(frames, count)):
            ltcl.images.write(folder / f"{number:03}.png", TO_LINEAR[codes])
        video = Path(parent) / "film.mp4"
        write_video(video, (TO_LINEAR[codes] for codes in cycle(frames, count)))
        settings: dict[str, Any] = {"rtol": RTOL, "clamp": True, "inverse": inverse}
        patterns = Path(parent) / "patterns"
        ltcl.batch.compensate_frames(T, folder, patterns, **settings)
        written = [ltcl.images.read_codes(file) for file in sorted(patterns.glob("*.png"))]

        def run() -> None:
            with tempfile.TemporaryDirectory() as again:
                ltcl.batch.compensate_frames(T, folder, again, **settings)

        actions: dict[str, Callable[[], object]] = {
            "png": run,
            "png alone": lambda: copy_frames(folder, Path(parent) / "copy", written),
            "video": lambda: play_through(T, inverse, video, out),
            "video alone": lambda: [out.write(frame.srgb().data) for frame in open_frames(video)],
        }
        times = seconds(actions, 1 if options.smoke else 3)
    rows = []
    for name, title in (("png", ".png to .png"), ("video", ".mp4 to a pipe")):
        alone = count / times[f"{name} alone"]
        rate = count / times[name]
        asked = f"reading and writing alone, {alone:.0f} frames/s"
        rows.append(Row(f"film, {title}", asked, alone, rate, "frames/s", rate / alone, 0.9))
    return rows


@contextmanager
def pipe() -> Iterator[Any]:
    """A pipe to a program that reads all and keeps nothing."""
    words = [sys.executable, "-c", READER]
    with subprocess.Popen(words, stdin=subprocess.PIPE) as reader:  # noqa: S603
        yield reader.stdin


def copy_frames(folder: Path, out: Path, written: list[np.ndarray]) -> None:
    """Read the frames of a folder and write codes for each, on two threads."""

    def copy(frame: Any) -> None:
        frame.digest()
        frame.picture()
        ltcl.images.write_codes(out / f"{frame.number}.png", written[frame.number - 1])

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(copy, open_frames(folder)))


def play_through(T: Transport, inverse: ltcl.Inverse, video: Path, out: Any) -> None:
    """All frames of a video through a pipeline, and on through a pipe."""
    with ltcl.Compensator(T, rtol=RTOL, clamp=True, inverse=inverse) as compensator:
        futures = [compensator.submit(frame.srgb()) for frame in open_frames(video)]
        for future in futures:
            out.write(cast(np.ndarray, future.result()).data)


# A projector's own pixels.


def sketch_like(options: Options, grid: tuple[int, int], cell: int) -> Transport:
    """T = (I + W^T C W) F, with W means of cells, as of a scene that a sketch has measured."""
    h, w = grid[0] // cell, grid[1] // cell
    W = Wavelet(options.device, grid, "db2", levels=cell.bit_length() - 1)
    core = symmetric_core(grid, (h, w))
    matrices = []
    for albedo in ALBEDO:
        scale = albedo / (1.0 - albedo)
        restricted, basis = ltcl.operators.restrict_to_support((core * scale).astype(np.float32), W)
        tiles = ltcl.operators.Tiles(options.device, restricted, 1, "float16")
        R = Compressed(tiles, basis, basis, 0.0, diagonal=np.zeros(grid[0] * grid[1]))
        matrices.append(ScaledColumns(IdentityPlus(R), np.full(grid[0] * grid[1], albedo)))
    first_bounce = np.repeat(np.array(ALBEDO)[:, None], grid[0] * grid[1], axis=1)
    return Transport(matrices, grid, first_bounce=first_bounce)


def large_rows(options: Options) -> list[Row]:
    """1080 x 1920 pixels in colour, with solves of each frame, and of every second one."""
    grid = (32, 64) if options.smoke else (1080, 1920)
    T = sketch_like(options, grid, 8)
    # An odd number, so that each is one whose bounces are computed in turn.
    frames = film(T, 3)
    count = 2 if options.smoke else 20
    whole = one_by_one(T, frames, count)
    half = one_by_one(T, frames, 2 * count, period=2, bounces_every=2)
    name = "1080 x 1920, colour, solves"
    return [
        rate_row(f"{name}: one by one", whole["rate"], 15.0),
        rate_row(f"{name}, bounces of every second frame: one by one", half["rate"], 24.0),
    ]


def frame_facts(T: Transport) -> dict[str, Any]:
    """Products and errors of one frame."""
    (codes,) = film(T, 1)
    compensation = ltcl.compensate(T, TO_LINEAR[codes], rtol=RTOL, clamp=True)
    with ltcl.Compensator(T, rtol=RTOL, clamp=True) as compensator:
        compensator(codes)
        judged = compensator.judge()
        products = compensator.statistics.products
        before = T.device.launches.copy()
        compensator(codes)
        launches = (T.device.launches - before).total()
    return {
        "products of a prepared frame": products,
        "launches of a prepared frame": launches,
        "error of a prepared frame": judged.error,
        "error of compensate": compensation.error,
        "clipped": compensation.clipped,
    }


def main() -> None:
    options = parse_options(__doc__)
    grid, coarse = ((16, 32), (4, 8)) if options.smoke else ((256, 512), (32, 64))
    T = transport(options, grid, coarse)
    inverse = ltcl.invert(T, RTOL)
    frames = film(T, BATCH)
    rows = [
        *prepared_rows(options, T, inverse, frames),
        *compensate_rows(options, T, inverse, frames),
        *film_rows(options, T, inverse, frames),
        *large_rows(options),
    ]
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
