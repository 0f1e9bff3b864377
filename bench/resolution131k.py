# SPDX-License-Identifier: BSD-3-Clause
"""The paper's resolution (figures 1 and 10): 131072 pixels, every one of which lights every other.

A coloured corner of two walls, 256 x 256 pixels each. R has 1.7e10 numbers none of which is small
beside its neighbours, 69 GB a colour, and is never formed:

    A     rows from closed-form form factors, thresholded between db2 wavelets as they stream by
    R     (I - A)^-1 - I by Chebyshev's form of eq. 21, on coefficients
    T     (I + R) F, solved on coefficients

A picture in colour is compensated and its bounces are separated to 1 %, the former with fewer
numbers of R. The truth needs no inverse: of a picture l the direct light is l - A l, and bounce k +
1 is A times bounce k. These products take all numbers of A, by a Fourier transform along the seam.
"""

from __future__ import annotations

import functools
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _coefficients import analysis, keep_fewest, note, relative_error, transport
from _corner import Bounce
from _figures import Claim
from _harness import Options, milliseconds, parse_options, product
from ltcl.images import to_srgb
from ltcl.operators import CSR, Compressed, IdentityPlus, Wavelet, restrict_to_support
from ltcl.scenes import dihedral, landscape
from ltcl.scenes.camera import draw as draw_view
from ltcl.tasks.compression import SparseInverse, invert_coefficients
from ltcl.tasks.compression.coefficients import Coefficients, coefficients
from ltcl.tasks.compression.sources import source

ALBEDO = (0.8, 0.65, 0.5)
# Albedo of the rows of A; the rows of the colours are multiples of them.
REFERENCE = 0.5
# Numbers of A below this are dropped.
THRESHOLD = 2e-5
# Error of solutions with R.
RTOL = 5e-4
ERROR = 1e-2
# Error of the solves from which bounces come, which are small beside them.
SEPARATION_RTOL = 2e-4
# Share of the error of a pattern that dropped numbers of R may take.
DROPPED_SHARE = 0.6
BLOCK_BYTES = 1 << 28
BOUNCES = 2
# Pictures are in this range, which the projector reaches.
PICTURE_BASE = 0.05
PICTURE_RANGE = 0.4
# Factor by which bounces are drawn brighter.
BOUNCE_GAIN = 4.0
MS_TARGETS = {"solve in colour": 5.0, "compensate in colour": 10.0}


def bounce(rows: Bounce, light: np.ndarray) -> np.ndarray:
    """A_c l_c of every channel, (N, 3) float64, with every number of A; direct is l - A l."""
    return rows.matmat(light) * (np.array(ALBEDO) / REFERENCE)


def scaled_landscape(h: int, w: int) -> np.ndarray:
    """A picture in colour, (h, w, 3) float64."""
    return PICTURE_BASE + PICTURE_RANGE * landscape(h, w).astype(np.float64)


class Stopwatch(dict[str, float]):
    """Seconds by the name of what took them."""

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block and note it."""
        start = time.perf_counter()
        yield
        self[name] = time.perf_counter() - start
        note(f"{name}: {self[name]:.3g} s")


@dataclass(frozen=True, kw_only=True)
class Built:
    """The transport and its parts; `lighter` is T of the `fewer` numbers that patterns need."""

    A: Coefficients
    R: list[SparseInverse]
    fewer: list[Any]
    T: ltcl.Transport
    lighter: ltcl.Transport
    spent: Stopwatch

    def compensate(self, picture: np.ndarray) -> ltcl.Compensation:
        """The pattern for a picture, however much light it takes."""
        return ltcl.compensate(self.lighter, picture, bounds=(-10.0, 10.0), rtol=ERROR)


def build(options: Options, rows: Bounce) -> Built:
    """The transport, from rows of A alone."""
    W = Wavelet(options.device, rows.grid, "db2")
    spent = Stopwatch()
    with spent("compressing A"):
        transform = analysis(W)
        blocks = source("A", rows, BLOCK_BYTES)
        A = coefficients(blocks, transform, transform, THRESHOLD, first=THRESHOLD / 4)
    inverses = []
    for albedo in ALBEDO:
        with spent(f"R of albedo {albedo:g}"):
            core = A.core * np.float32(albedo / REFERENCE)
            inverses.append(invert_coefficients(-core.astype(np.float32), rtol=RTOL))
    cores = [-inverse.D for inverse in inverses]
    with spent("what a pattern needs of R"):
        fewer = fewest_for_patterns(W, rows, cores)
    return Built(
        A=A,
        R=inverses,
        fewer=fewer,
        T=transport(W, cores, ALBEDO),
        lighter=transport(W, fewer, ALBEDO),
        spent=spent,
    )


def fewest_for_patterns(W: Wavelet, rows: Bounce, cores: list[Any]) -> list[Any]:
    """Drop numbers of each core until the direct light of another picture is off by 0.6 %."""
    h, w = rows.grid
    picture = scaled_landscape(h, w).mean(axis=2)
    grey = np.roll(picture, (h // 3, w // 5), (0, 1)).reshape(-1)
    exact = grey[:, None] - bounce(rows, grey[:, None])

    def error(truth: np.ndarray, core: Any) -> float:
        core, V = restrict_to_support(core, W)
        S = IdentityPlus(Compressed(CSR(W.device, core), V, V))
        solution = ltcl.solve(S, grey, "chebyshev", rtol=SEPARATION_RTOL)
        return relative_error(solution.x, truth)

    fewer = []
    for core, truth in zip(cores, exact.T, strict=True):
        channel_error = functools.partial(error, truth)
        fewer.append(keep_fewest(core, channel_error, DROPPED_SHARE * ERROR))
    return fewer


def pictures(rows: Bounce, built: Built) -> tuple[list[np.ndarray], list[float]]:
    """A landscape, its pattern, direct light and bounces, (h, w, 3), and errors of all but it."""
    desired = scaled_landscape(*rows.grid)
    with built.spent("compensate, first call"):
        pattern = built.compensate(desired).pattern
    with built.spent("separate, first call"):
        separation = ltcl.separate(built.T, desired, BOUNCES, rtol=SEPARATION_RTOL)
    l_out = desired.reshape(-1, 3)
    direct = l_out - bounce(rows, l_out)
    truth = [direct]
    for _ in range(BOUNCES):
        truth.append(bounce(rows, truth[-1]))
    parts = [separation.direct, *separation.bounces]
    errors = [relative_error((pattern * ALBEDO).reshape(-1, 3), direct)]
    for part, exact in zip(parts, truth, strict=True):
        errors.append(relative_error(part.reshape(-1, 3), exact))
    return [desired, pattern, *parts], errors


def draw(names: list[str], images: list[np.ndarray]) -> Figure:
    pixels = np.prod(images[0].shape[:2])
    figure = figures.page(
        270,
        f"{pixels} pixels, each of which lights all of the other wall",
        "A picture on a corner of two walls, the pattern that makes it, "
        "and its light by bounces (4 times).",
    )
    walls = dihedral(2)
    gains = [1.0, 0.6, 1.0] + BOUNCES * [BOUNCE_GAIN]
    views = []
    for label, image, gain in zip(["wanted", *names], images, gains, strict=True):
        light = image.astype(np.float32)
        view = draw_view(walls.viewer, walls.walls, light, 400, 2)
        views.append((to_srgb(np.clip(gain * view, 0, 1)), label))
    figures.pictures(figure, 110, views)
    return figure


def measure_ms(built: Built, picture: np.ndarray) -> dict[str, float]:
    """Milliseconds of products and tasks."""
    columns = picture.reshape(-1, 3).astype(np.float32)
    R = cast(Compressed, built.lighter.systems[0].R)
    core_x = np.zeros(R.core.shape[1], np.float32)

    def solve() -> None:
        for channel, S in enumerate(built.lighter.systems):
            ltcl.solve(S, columns[:, channel], rtol=ERROR)

    actions = {
        "product, on coefficients": product(R.core, core_x),
        "product, in pixels": product(R, columns[:, 0]),
        "solve in colour": solve,
        "compensate in colour": lambda: built.compensate(picture),
    }
    return milliseconds(actions)


def build_facts(options: Options, built: Built, n: int, ms: dict[str, float]) -> dict[str, Any]:
    row_counts = ", ".join(f"{inverse.D.nnz / n:.3g}" for inverse in built.R)
    fewer_counts = ", ".join(f"{core.nnz / n:.3g}" for core in built.fewer)
    facts: dict[str, Any] = {
        "pixels": n,
        "A, numbers a row": built.A.core.nnz / n,
        "A, dropped (Frobenius, at most)": built.A.dropped,
        "R, numbers a row": row_counts,
        "R, products of eq. 21": ", ".join(str(inverse.products) for inverse in built.R),
        "R, error of (I + R)(I - A~), bound": max(inverse.error for inverse in built.R),
        "R for patterns, numbers a row": fewer_counts,
        "bytes of T, for bounces and for patterns": f"{built.T.nbytes}, {built.lighter.nbytes}",
        "bytes of R, were it dense": 3 * 4 * n * n,
    }
    facts |= {f"{name}, s": spent for name, spent in built.spent.items()}
    facts |= {f"{name}, ms": spent for name, spent in ms.items()}
    usage = resource.getrusage(resource.RUSAGE_SELF)
    facts["peak memory, MB"] = usage.ru_maxrss / 1024
    facts["largest buffer allowed, MB"] = options.device.max_allocation / 2**20
    return facts


def claims(names: list[str], errors: list[float], ms: dict[str, float]) -> list[Claim]:
    listed = []
    for name, error in zip(names, errors, strict=True):
        text = f"{name} of 131072 pixels in colour"
        limit = f"at most {ERROR:.0%}"
        listed.append(Claim(text, f"error {error:.2%}", limit, error <= ERROR))
    for name, most in MS_TARGETS.items():
        is_fast = ms[name] <= most
        text = f"{name}, 1 %"
        limit = f"at most {most:g} ms"
        listed.append(Claim(text, f"{ms[name]:.3g} ms", limit, is_fast))
    return listed


def main() -> None:
    options = parse_options(__doc__)
    rows = Bounce(8 if options.smoke else 256, REFERENCE)
    built = build(options, rows)
    images, errors = pictures(rows, built)
    ms = measure_ms(built, images[0])
    facts = build_facts(options, built, rows.shape[0], ms)
    names = ["pattern", "direct"] + [f"bounce {k}" for k in range(1, BOUNCES + 1)]
    listed = []
    if not options.smoke:
        listed = claims(names, errors, ms)
    title = "131072 pixels in colour"
    figures.conclude(options, title, listed, facts, lambda: draw(names, images))


if __name__ == "__main__":
    main()
