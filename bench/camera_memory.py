# SPDX-License-Identifier: BSD-3-Clause
"""Memory of a whole acquisition, by the megapixels of a colour camera.

A camera of 8 bits looks at a plane that the projector fills, with a tenth of the light from
everywhere. `ltcl.acquire` measures the set-up with Gray code and scans a few blocks. The peak of
the resident memory is that of the process, beyond what it held before the first photograph; its
photographs are in it, one at a time. The light of the transport is compared with the known one.

    python bench/camera_memory.py --megapixels 45
"""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from functools import partial

import numpy as np
import psutil
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _figures import Claim
from _harness import parse_options
from ltcl.images import from_srgb, to_srgb

GRID = (68, 120)
# Pixels of a block of the scan along each side: it has (2, 4).
BLOCK = 34
# Photographs of black and of white that are averaged: they take time, not memory.
FRAMES = 4
# Largest memory of 45 megapixels, in bytes.
LIMIT = 2e9
LARGEST_CAMERA = 45e6
# Resident memory that threads and small arrays may take at any size.
FIXED_BYTES = 350e6
# Largest relative error of the transport.
MAX_ERROR = 0.01
# Light of a projector pixel at its own place, from everywhere, and without the projector.
DIRECT = 0.8
INDIRECT = 0.1
AMBIENT = 0.01
ALBEDO = np.array([0.9, 0.8, 0.7])
# Of the camera: electrons at full scale, read noise, code without light; relative to full scale.
ELECTRONS = 10000.0
READ_NOISE = 0.001
BLACK = 0.004
# Part of each side of a photograph around the projector's picture.
MARGIN = 0.04
# Rows of a photograph that are computed at once, and values of noise that are used again.
ROWS_AT_ONCE = 8
NOISE_VALUES = 1 << 22
ARGUMENTS = {
    "megapixels": {"type": float, "default": 3.0, "help": "pixels of the camera, in millions"}
}


class PlaneRig:
    """A projector and a colour camera of any size, whose photographs are made row by row."""

    projector_grid: tuple[int, int] = GRID
    channels = 3

    def __init__(self, camera_grid: tuple[int, int]) -> None:
        self.camera_grid = camera_grid
        self.count = 0
        self.seconds = 0.0
        self.random = np.random.default_rng(0)
        values = NOISE_VALUES + ROWS_AT_ONCE * camera_grid[1] * 3
        self.noise = self.random.standard_normal(values, np.float32)
        self.places = []
        for camera_side, side in zip(camera_grid, GRID, strict=True):
            place = (np.arange(camera_side) + 0.5) / camera_side
            projector_place = (place - MARGIN) / (1.0 - 2.0 * MARGIN) * side
            # Pixels 0 and side + 1 are outside the picture.
            self.places.append(np.clip(np.floor(projector_place) + 1, 0, side + 1).astype(int))

    def describe(self) -> dict[str, object]:
        """The rig as plain JSON."""
        return {"kind": "plane", "camera_grid": self.camera_grid}

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Photograph of 8 bits, (H, W, 3)."""
        start = time.perf_counter()
        mean, deviation = self._codes(codes, seconds)
        H, W = self.camera_grid
        image = np.empty((H, W, 3), np.uint8)
        rows, columns = self.places
        for line in range(GRID[0] + 2):
            first, last = np.searchsorted(rows, [line, line + 1])
            line_mean = mean[line, columns].ravel()
            line_deviation = deviation[line, columns].ravel()
            for top in range(first, last, ROWS_AT_ONCE):
                strip = image[top : min(top + ROWS_AT_ONCE, last)].reshape(-1, 3 * W)
                start_of_noise = self.random.integers(len(self.noise) - strip.size)
                noise = self.noise[start_of_noise : start_of_noise + strip.size]
                values = noise.reshape(strip.shape) * line_deviation
                values += line_mean
                np.clip(values, 0.0, 255.0, out=values)
                strip[:] = values
        self.count += 1
        self.seconds += time.perf_counter() - start
        return image

    def _codes(self, codes: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean code of each projector pixel and its surroundings, (h + 2, w + 2, 3), and noise."""
        light = from_srgb(codes)
        if light.ndim == 2:
            light = np.repeat(light[..., None], 3, axis=2)
        direct = np.pad(DIRECT * light, ((1, 1), (1, 1), (0, 0)))
        radiance = ALBEDO * (direct + INDIRECT * light.mean(axis=(0, 1))) + AMBIENT
        value = np.minimum(seconds * radiance, 1.0)
        step = 1e-4
        slope = (to_srgb(value) - to_srgb(np.maximum(value - step, 0.0))) / step
        deviation = slope * np.sqrt(value / ELECTRONS + READ_NOISE**2)
        mean = BLACK + (1.0 - BLACK) * to_srgb(value)
        # Codes are cut off to whole ones: half a code more rounds them.
        return (255.0 * mean + 0.5).astype(np.float32), (255.0 * deviation).astype(np.float32)


class PeakMemory:
    """Largest resident memory of this process beyond that at the start, by a thread."""

    def __init__(self) -> None:
        self._process = psutil.Process()
        self._start = self._process.memory_info().rss
        self._stopped = threading.Event()
        self.bytes = 0
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> int:
        """Stop watching, and return the peak in bytes."""
        self._stopped.set()
        self._thread.join()
        return self.bytes

    def _watch(self) -> None:
        while not self._stopped.wait(0.01):
            self.bytes = max(self.bytes, self._process.memory_info().rss - self._start)


class StepMemory:
    """Peak memory and seconds of each step of an acquisition, told by its progress."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._peak = PeakMemory()
        self.steps: dict[str, tuple[float, int]] = {}

    def progress(self, step: str, done: int, total: int) -> None:
        """Note the time and the memory so far."""
        self.steps[step] = time.perf_counter() - self._start, self._peak.bytes

    def stop(self) -> int:
        """Stop watching, and return the peak in bytes."""
        return self._peak.stop()


def relative_error(T: ltcl.Transport) -> float:
    """Relative error of the transport, whose unit of light is unknown."""
    h, w = T.grid
    blocks = h * w
    pixels = np.zeros(T.grid)
    for top in range(h):
        for left in range(w):
            rows = min(BLOCK, GRID[0] - BLOCK * top)
            columns = min(BLOCK, GRID[1] - BLOCK * left)
            pixels[top, left] = rows * columns
    shares = pixels.ravel() / (GRID[0] * GRID[1])
    expected = DIRECT * np.eye(blocks) + INDIRECT * shares
    errors = []
    for channel, albedo in enumerate(ALBEDO):
        measured = np.asarray(T.matrices[channel] @ np.eye(blocks))
        exact = albedo * expected
        scale = np.sum(measured * exact) / np.sum(measured**2)
        errors.append(np.linalg.norm(scale * measured - exact) / np.linalg.norm(exact))
    return float(max(errors))


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__, ARGUMENTS)
    logging.disable(logging.WARNING)
    pixels = 1e6 * options.arguments.megapixels
    if options.smoke:
        pixels = 3e5
    height = round(np.sqrt(pixels * 3 / 4))
    camera_grid = (height, 4 * height // 3)
    pixels = camera_grid[0] * camera_grid[1]
    rig = PlaneRig(camera_grid)
    memory = StepMemory()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
        T = ltcl.acquire(
            rig,
            strategy="block",
            block=BLOCK,
            frames=FRAMES,
            store=f"{folder}/T.zarr",
            progress=memory.progress,
        )
        seconds = time.perf_counter() - start
        taken = memory.stop()
        error = relative_error(T)
    limit = FIXED_BYTES + (LIMIT - FIXED_BYTES) * pixels / LARGEST_CAMERA
    computing = seconds - rig.seconds
    claims = [
        Claim(
            text=f"memory of {pixels / 1e6:.3g} megapixels in colour, {rig.count} photographs",
            measured=f"{taken / 1e6:.0f} MB, {taken / pixels:.0f} bytes a camera pixel",
            wanted=f"at most {limit / 1e6:.0f} MB, 2 GB at 45 megapixels",
            holds=taken <= limit,
        ),
        Claim(
            text="relative error of the transport",
            measured=f"{error:.2%}",
            wanted=f"at most {MAX_ERROR:.0%}",
            holds=error <= MAX_ERROR,
        ),
    ]
    facts = {
        "megapixels": pixels / 1e6,
        "seconds of computing": computing,
        "of these a photograph and megapixel": computing / rig.count / (pixels / 1e6),
        "seconds of the rig": rig.seconds,
        "seconds and peak MB at the end of each step": {
            step: [round(end, 1), round(peak / 1e6)] for step, (end, peak) in memory.steps.items()
        },
    }
    figures.conclude(
        options, "Memory of an acquisition by camera", claims, facts, partial(draw, taken, pixels)
    )


def draw(taken: int, pixels: int) -> Figure:
    """Draw the memory of this run, and the goal."""
    figure = figures.page(360, "Memory of an acquisition in colour", "Megabytes by megapixels.")
    axes = figures.graph(figure, (90, 110, 380, 180), "resident memory", "megapixels", "MB")
    axes.plot([pixels / 1e6], [taken / 1e6], "o", label="measured")
    axes.plot([LARGEST_CAMERA / 1e6], [LIMIT / 1e6], "x", label="goal")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    main()
