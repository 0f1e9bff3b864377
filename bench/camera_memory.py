# SPDX-License-Identifier: BSD-3-Clause
"""Memory of a map from Gray code, by the megapixels of the camera.

Photographs of a plane are appended to a file one at a time, as a calibration does, and decoded in
strips of rows. The peak of the resident memory is that of the process, beyond what it held before
the first photograph; the rest of a calibration is not in it.

    python bench/camera_memory.py --megapixels 45
"""

from __future__ import annotations

import threading
import time
from functools import partial

import cv2
import numpy as np
import psutil
from matplotlib.figure import Figure

import _figures as figures
from _figures import Claim
from _harness import parse_options
from ltcl.acquisition.geometry import GrayCode, decode
from ltcl.acquisition.geometry.photographs import PhotographFile

GRID = (68, 120)
# Largest memory of 45 megapixels, in bytes.
LIMIT = 2e9
LARGEST_CAMERA = 45e6
# Resident memory that threads and small arrays may take at any size.
FIXED_BYTES = 200e6
ARGUMENTS = {
    "megapixels": {"type": float, "default": 3.0, "help": "pixels of the camera, in millions"}
}


def append_photographs(file: PhotographFile, camera_grid: tuple[int, int]) -> None:
    """Append photographs of 8 bits, of a plane that the projector fills."""
    H, W = camera_grid
    for pattern in GrayCode(GRID).patterns():
        image = cv2.resize(pattern, (W, H), interpolation=cv2.INTER_LINEAR)
        image *= np.float32(0.8)
        image += np.float32(0.1)
        file.append(image)


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


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__, ARGUMENTS)
    pixels = 1e6 * options.arguments.megapixels
    if options.smoke:
        pixels = 3e5
    height = round(np.sqrt(pixels * 3 / 4))
    camera_grid = (height, 4 * height // 3)
    pixels = camera_grid[0] * camera_grid[1]
    peak = PeakMemory()
    file = PhotographFile()
    append_photographs(file, camera_grid)
    start = time.perf_counter()
    mapping = decode(file, GRID, levels=256)
    seconds = time.perf_counter() - start
    taken = peak.stop()
    limit = FIXED_BYTES + (LIMIT - FIXED_BYTES) * pixels / LARGEST_CAMERA
    claim = Claim(
        text=f"memory of {pixels / 1e6:.3g} megapixels, {file.count} photographs",
        measured=f"{taken / 1e6:.0f} MB, {taken / pixels:.0f} bytes a camera pixel",
        wanted=f"at most {limit / 1e6:.0f} MB, 2 GB at 45 megapixels",
        holds=taken <= limit,
    )
    facts = {"seconds": seconds, "decoded": mapping.decoded}
    figures.conclude(
        options, "Memory of Gray code by camera", [claim], facts, partial(draw, taken, pixels)
    )


def draw(taken: int, pixels: int) -> Figure:
    """Draw the memory of this run, and the goal."""
    figure = figures.page(360, "Memory of a map from Gray code", "Megabytes by megapixels.")
    axes = figures.graph(figure, (90, 110, 380, 180), "resident memory", "megapixels", "MB")
    axes.plot([pixels / 1e6], [taken / 1e6], "o", label="measured")
    axes.plot([LARGEST_CAMERA / 1e6], [LIMIT / 1e6], "x", label="goal")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    main()
