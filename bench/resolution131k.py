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
from _harness import Options, parse_options, product, seconds
from ltcl.images import to_srgb
from ltcl.operators import CSR, Compressed, IdentityPlus, Wavelet, restrict_to_support
from ltcl.scenes import dihedral, landscape
from ltcl.scenes.camera import draw as draw_view
from ltcl.tasks.compression import SparseInverse, invert_coefficients
from ltcl.tasks.compression.coefficients import Coefficients, coefficients
from ltcl.tasks.compression.sources import source

ALBEDO, REFERENCE = (0.8, 0.65, 0.5), 0.5
THRESHOLD, RTOL = 2e-5, 5e-4  # of numbers of A; of solutions with R
ERROR, SEPARATION = (
    1e-2,
    2e-4,
)  # wanted; of the solves from which bounces come, which are small beside them
SHARE = 0.6  # of the error of a pattern, what may be left out of R for it
MEMORY = 1 << 28  # bytes of a block of rows
BOUNCES = 2
TARGETS = {"solve in colour": 5.0, "compensate in colour": 10.0}  # ms


def bounce(rows: Bounce, light: np.ndarray) -> np.ndarray:
    """A_c l_c of every channel, (N, 3) float64, with every number of A; direct is l - A l."""
    return rows.matmat(light) * (np.array(ALBEDO) / REFERENCE)


class Stopwatch(dict[str, float]):
    """Seconds by what they were spent on."""

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block and note it."""
        start = time.perf_counter()
        yield
        self[name] = time.perf_counter() - start
        note(f"{name}: {self[name]:.3g} s")


@dataclass(frozen=True)
class Built:
    """What was made on the way to T; `lighter` is T of the `fewer` numbers that patterns need."""

    A: Coefficients
    R: list[SparseInverse]
    fewer: list[Any]
    T: ltcl.Transport
    lighter: ltcl.Transport
    spent: Stopwatch

    def compensate(self, picture: np.ndarray) -> ltcl.Compensation:
        """The pattern for a picture, whatever light it takes."""
        return ltcl.compensate(self.lighter, picture, bounds=(-10.0, 10.0), rtol=ERROR)


def build(given: Options, rows: Bounce) -> Built:
    """The transport, from rows of A alone."""
    W, spent = Wavelet(given.device, rows.grid, "db2"), Stopwatch()
    with spent("compressing A"):
        transform, blocks = analysis(W), source("A", rows, MEMORY)
        A = coefficients(blocks, transform, transform, THRESHOLD, first=THRESHOLD / 4)
    found = []
    for albedo in ALBEDO:
        with spent(f"R of albedo {albedo:g}"):
            C = (A.core * np.float32(albedo / REFERENCE)).astype(np.float32)
            found.append(invert_coefficients(-C, rtol=RTOL))
    cores, fewer, (h, w) = [-one.D for one in found], [], rows.grid
    with spent(
        "what a pattern needs of R"
    ):  # that the direct light of another picture is off by 0.6 %
        picture = 0.05 + 0.4 * landscape(h, w).astype(np.float64)
        grey = np.roll(picture.mean(axis=2), (h // 3, w // 5), (0, 1)).reshape(-1)
        exact = grey[:, None] - bounce(rows, grey[:, None])
        for C, truth in zip(cores, exact.T, strict=True):

            def error(core: Any, truth: np.ndarray = truth) -> float:
                core, V = restrict_to_support(core, W)
                S = IdentityPlus(Compressed(CSR(given.device, core), V, V))
                return relative_error(ltcl.solve(S, grey, "chebyshev", rtol=SEPARATION).x, truth)

            fewer.append(keep_fewest(C, error, SHARE * ERROR))
    return Built(A, found, fewer, transport(W, cores, ALBEDO), transport(W, fewer, ALBEDO), spent)


def pictures(rows: Bounce, built: Built) -> tuple[list[np.ndarray], list[float]]:
    """A landscape, its pattern, direct light and bounces, (h, w, 3) each; errors of all but the first."""
    wanted = 0.05 + 0.4 * landscape(*rows.grid).astype(np.float64)
    with built.spent("compensate, first call"):
        pattern = built.compensate(wanted).pattern
    with built.spent("separate, first call"):
        separation = ltcl.separate(built.T, wanted, BOUNCES, rtol=SEPARATION)
    l_out = wanted.reshape(-1, 3)
    exact = [l_out - bounce(rows, l_out)]
    for _ in range(BOUNCES):
        exact.append(bounce(rows, exact[-1]))
    parts = [separation.direct, *separation.bounces]
    pairs = zip([pattern * ALBEDO, *parts], [exact[0], *exact], strict=True)
    return [wanted, pattern, *parts], [
        relative_error(part.reshape(-1, 3), truth) for part, truth in pairs
    ]


def draw(names: list[str], images: list[np.ndarray]) -> Figure:
    figure = figures.page(
        270,
        f"{np.prod(images[0].shape[:2])} pixels, each of which lights all of the other wall",
        "A picture on a corner of two walls, the pattern that makes it, and its light by bounces (4 times).",
    )
    walls, gains, views = dihedral(2), (1.0, 0.6, 1.0, *(BOUNCES * [4.0])), []
    for label, image, gain in zip(["wanted", *names], images, gains, strict=True):
        view = draw_view(walls.viewer, walls.walls, image.astype(np.float32), 400, 2)
        views.append((to_srgb(np.clip(gain * view, 0, 1)), label))
    figures.pictures(figure, 110, views)
    return figure


def main() -> None:
    given = parse_options(__doc__ or "")
    rows = Bounce(8 if given.smoke else 256, REFERENCE)
    built = build(given, rows)
    images, errors = pictures(rows, built)
    pixels, R = (
        images[0].reshape(-1, 3).astype(np.float32),
        cast(Compressed, built.lighter.systems[0].R),
    )

    def solve() -> None:
        for c, S in enumerate(built.lighter.systems):
            ltcl.solve(S, pixels[:, c], rtol=ERROR)

    actions = {
        "product, on coefficients": product(R.core, np.zeros(R.core.shape[1], np.float32)),
        "product, in pixels": product(R, pixels[:, 0]),
        "solve in colour": solve,
        "compensate in colour": lambda: built.compensate(images[0]),
    }
    ms = {name: 1e3 * spent for name, spent in seconds(actions).items()}
    n = rows.shape[0]
    facts: dict[str, Any] = {
        "pixels": n,
        "A, numbers a row": built.A.core.nnz / n,
        "A, dropped (Frobenius, at most)": built.A.dropped,
        "R, numbers a row": ", ".join(f"{one.D.nnz / n:.3g}" for one in built.R),
        "R, products of eq. 21": ", ".join(str(one.products) for one in built.R),
        "R, error of (I + R)(I - A~), bound": max(one.error for one in built.R),
        "R for patterns, numbers a row": ", ".join(f"{one.nnz / n:.3g}" for one in built.fewer),
        "bytes of T, for bounces and for patterns": f"{built.T.nbytes}, {built.lighter.nbytes}",
        "bytes of R, were it dense": 3 * 4 * n * n,
        **{f"{name}, s": spent for name, spent in built.spent.items()},
        **{f"{name}, ms": spent for name, spent in ms.items()},
        "peak memory, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "largest buffer allowed, MB": given.device.max_allocation / 2**20,
    }
    names = ["pattern", "direct", *(f"bounce {k + 1}" for k in range(BOUNCES))]
    claims, limit = [], f"at most {ERROR:.0%}"
    for name, error in zip(names, errors, strict=True):
        text = f"{name} of 131072 pixels in colour"
        claims.append(Claim(text, f"error {error:.2%}", limit, error <= ERROR))
    for name, most in TARGETS.items():
        claims.append(
            Claim(f"{name}, 1 %", f"{ms[name]:.3g} ms", f"at most {most:g} ms", ms[name] <= most)
        )
    title = "131072 pixels in colour"
    figures.conclude(
        given, title, [] if given.smoke else claims, facts, lambda: draw(names, images)
    )


if __name__ == "__main__":
    main()
