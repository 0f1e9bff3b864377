# SPDX-License-Identifier: BSD-3-Clause
"""T of a coloured corner from rows of its A alone, for `resolution131k.py`: R is never formed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console

import ltcl
from _harness import Options
from _kept import bisect
from ltcl.compression import SparseInverse, invert_coefficients
from ltcl.compression.coefficients import Coefficients, coefficients, drop_below
from ltcl.operators import CSR, Compressed, IdentityPlus, ScaledColumns, Tiles, Wavelet, restrict_to_support
from ltcl.scenes import CornerRows, landscape

ALBEDO, REFERENCE = (0.8, 0.65, 0.5), 0.5
THRESHOLD, RTOL = 2e-5, 5e-4  # of numbers of A; of solutions with R
ERROR, SEPARATION = 1e-2, 2e-4  # wanted; of the solves from which bounces come, which are small beside them
SHARE = 0.6  # of the error of a pattern, what may be left out of R for it
MEMORY = 1 << 28  # bytes of a block of rows
note = Console(stderr=True).print


@dataclass(frozen=True)
class Corner:
    """Rows of A of a reference albedo; A of a channel is a multiple of it."""

    rows: CornerRows

    @property
    def pixels(self) -> int:
        """N."""
        return self.rows.shape[0]

    def bounce(self, light: np.ndarray) -> np.ndarray:
        """A_c l_c of every channel, (N, 3) float64, with every number of A."""
        return self.rows.matmat(light) * (np.array(ALBEDO) / REFERENCE)

    def direct(self, light: np.ndarray) -> np.ndarray:
        """Direct light of a picture, (N, 3) float64, in every channel."""
        return light - self.bounce(light)


@dataclass(frozen=True)
class Built:
    """What was made on the way to T; `lighter` is T of the `fewer` numbers that patterns need."""

    A: Coefficients
    R: list[SparseInverse]
    fewer: list[Any]
    T: ltcl.Transport
    lighter: ltcl.Transport
    spent: dict[str, float]


class Stopwatch(dict[str, float]):
    """Seconds by what they were spent on."""

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block and say so."""
        start = time.perf_counter()
        yield
        self[name] = time.perf_counter() - start
        note(f"{name}: {self[name]:.3g} s")


def build(given: Options, corner: Corner) -> Built:
    """The transport, from rows of A alone."""
    W, spent = Wavelet(given.device, corner.rows.grid, "db2"), Stopwatch()

    def transform(x: np.ndarray) -> np.ndarray:
        return W.apply(given.device.upload(x)).get()

    def progress(share: float, last: list[float] = [0.0]) -> None:  # noqa: B006 - kept between calls
        if share >= last[0] + 0.05:
            last[0] = share
            note(f"  compressing, {share:.0%}")

    with spent("compressing A"):
        A = coefficients(
            corner.rows,
            transform,
            transform,
            THRESHOLD,
            first=THRESHOLD / 4,
            memory=MEMORY,
            progress=progress,
        )
    found = []
    for albedo in ALBEDO:
        with spent(f"R of albedo {albedo:g}"):
            C = (A.core * np.float32(albedo / REFERENCE)).astype(np.float32)
            found.append(invert_coefficients(C, -1, rtol=RTOL))
    cores = [one.D for one in found]
    with spent("what a pattern needs of R"):
        fewer = enough(given, corner, cores)
    return Built(A, found, fewer, transport(given, corner, cores), transport(given, corner, fewer), spent)


def transport(given: Options, corner: Corner, cores: list[Any]) -> ltcl.Transport:
    """T = (I + R) F of R on coefficients."""
    W, systems = Wavelet(given.device, corner.rows.grid, "db2"), []
    for C in cores:
        core, V = restrict_to_support(C, W)
        systems.append(IdentityPlus(Compressed(Tiles(given.device, core, 8, "float16"), V, V)))
    F = np.repeat(np.array(ALBEDO)[:, None], corner.pixels, axis=1)
    scaled = [ScaledColumns(S, f) for S, f in zip(systems, F, strict=True)]
    return ltcl.Transport(scaled, corner.rows.grid, first_bounce=F)


def enough(given: Options, corner: Corner, cores: list[Any]) -> list[Any]:
    """The largest numbers of R, with which the direct light of another picture is off by 0.6 %."""
    W, (h, w) = Wavelet(given.device, corner.rows.grid, "db2"), corner.rows.grid
    grey = np.roll(wanted_picture(corner).mean(axis=2), (h // 3, w // 5), (0, 1)).reshape(-1)
    exact, found = corner.direct(grey[:, None]), []
    for channel, C in enumerate(cores):
        truth = exact[:, channel]

        def error(threshold: float, C: Any = C, truth: np.ndarray = truth) -> float:
            core, V = restrict_to_support(drop_below(C, threshold)[0], W)
            S = IdentityPlus(Compressed(CSR(given.device, core), V, V))
            x = ltcl.solve(S, grey, "chebyshev", rtol=SEPARATION).x
            return float(np.linalg.norm(x - truth) / np.linalg.norm(truth))

        found.append(drop_below(C, bisect(error, SHARE * ERROR, float(np.abs(C.data).max())))[0])
    return found


def wanted_picture(corner: Corner) -> np.ndarray:
    """What the wall is to look like, (h, w, 3)."""
    return 0.05 + 0.4 * landscape(*corner.rows.grid).astype(np.float64)
