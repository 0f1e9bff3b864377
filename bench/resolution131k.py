# SPDX-License-Identifier: BSD-3-Clause
"""The paper's resolution (figures 1 and 10): 131072 pixels, every one of which lights every other.

A coloured corner of two walls, 256 x 256 pixels each. R has 1.7e10 numbers none of which is small beside its
neighbours, 69 GB a colour, and is never formed:

    A     rows from closed-form form factors, thresholded between db2 wavelets as they stream by
    R     (I - A)^-1 - I by Chebyshev's form of eq. 21, on coefficients
    T     (I + R) F, solved on coefficients

A picture in colour is compensated and its bounces are separated to 1 %, the former with fewer numbers of R.
The truth needs no inverse: of a picture l the direct light is l - A l, and bounce k + 1 is A times bounce k.
These products take all numbers of A, by a Fourier transform along the seam.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import _figures as figures
import ltcl
from _coefficients import analysis, bisect, note, relative, transport
from _corner import Bounce
from _figures import Claim
from _harness import Options, options, product, seconds
from ltcl.compression import SparseInverse, invert_coefficients
from ltcl.compression.coefficients import Coefficients, coefficients, drop_below
from ltcl.compression.sources import source
from ltcl.images import to_srgb
from ltcl.operators import CSR, Compressed, IdentityPlus, Wavelet, restrict_to_support
from ltcl.scenes import dihedral, landscape
from ltcl.scenes.viewer import draw as draw_view

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALBEDO, REFERENCE = (0.8, 0.65, 0.5), 0.5
THRESHOLD, RTOL = 2e-5, 5e-4  # of numbers of A; of solutions with R
ERROR, SEPARATION = 1e-2, 2e-4  # wanted; of the solves from which bounces come, which are small beside them
SHARE = 0.6  # of the error of a pattern, what may be left out of R for it
MEMORY = 1 << 28  # bytes of a block of rows
BOUNCES = 2
TARGETS = {"solve in colour": 5.0, "compensate in colour": 10.0}  # ms


@dataclass(frozen=True)
class Corner:
    """Rows of A of a reference albedo; A of a channel is a multiple of it."""

    rows: Bounce

    @property
    def picture(self) -> np.ndarray:
        """What the walls are to look like, (h, w, 3)."""
        return 0.05 + 0.4 * landscape(*self.rows.grid).astype(np.float64)

    def bounce(self, light: np.ndarray) -> np.ndarray:
        """A_c l_c of every channel, (N, 3) float64, with every number of A."""
        return self.rows.matmat(light) * (np.array(ALBEDO) / REFERENCE)

    def direct(self, light: np.ndarray) -> np.ndarray:
        """Direct light of a picture, (N, 3) float64, in every channel."""
        return light - self.bounce(light)


class Stopwatch(dict[str, float]):
    """Seconds by what they were spent on."""

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a block and say so."""
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


def build(given: Options, corner: Corner) -> Built:
    """The transport, from rows of A alone."""
    W, spent = Wavelet(given.device, corner.rows.grid, "db2"), Stopwatch()
    with spent("compressing A"):
        rows = source("A", corner.rows, MEMORY)
        A = coefficients(rows, analysis(W), analysis(W), THRESHOLD, first=THRESHOLD / 4)
    found = []
    for albedo in ALBEDO:
        with spent(f"R of albedo {albedo:g}"):
            C = (A.core * np.float32(albedo / REFERENCE)).astype(np.float32)
            found.append(invert_coefficients(-C, rtol=RTOL))
    cores = [-one.D for one in found]
    with spent("what a pattern needs of R"):
        fewer = enough(given, corner, cores)
    return Built(A, found, fewer, transport(W, cores, ALBEDO), transport(W, fewer, ALBEDO), spent)


def enough(given: Options, corner: Corner, cores: list[Any]) -> list[Any]:
    """The largest numbers of R, with which the direct light of another picture is off by 0.6 %."""
    W, (h, w) = Wavelet(given.device, corner.rows.grid, "db2"), corner.rows.grid
    grey = np.roll(corner.picture.mean(axis=2), (h // 3, w // 5), (0, 1)).reshape(-1)
    exact, found = corner.direct(grey[:, None]), []
    for channel, C in enumerate(cores):
        truth = exact[:, channel]

        def error(threshold: float, C: Any = C, truth: np.ndarray = truth) -> float:
            core, V = restrict_to_support(drop_below(C, threshold)[0], W)
            S = IdentityPlus(Compressed(CSR(given.device, core), V, V))
            return relative(ltcl.solve(S, grey, "chebyshev", rtol=SEPARATION).x, truth)

        found.append(drop_below(C, bisect(error, SHARE * ERROR, float(np.abs(C.data).max())))[0])
    return found


@dataclass(frozen=True)
class Pictures:
    """(h, w, 3) each; errors are of the pattern and the parts."""

    wanted: np.ndarray
    pattern: np.ndarray
    parts: list[np.ndarray]
    errors: list[float]


def compensate(built: Built, picture: np.ndarray) -> ltcl.Compensation:
    """The pattern for a picture, whatever light it takes."""
    return ltcl.compensate(built.lighter, picture, bounds=(-10.0, 10.0), rtol=ERROR)


def pictures(corner: Corner, built: Built) -> Pictures:
    """Compensate and separate a landscape, and compare with the truth."""
    wanted = corner.picture
    with built.spent("compensate, first call"):
        compensation = compensate(built, wanted)
    with built.spent("separate, first call"):
        separation = ltcl.separate(built.T, wanted, BOUNCES, rtol=SEPARATION)
    exact = [corner.direct(wanted.reshape(-1, 3))]
    for _ in range(BOUNCES):
        exact.append(corner.bounce(exact[-1]))
    parts = [separation.direct, *separation.bounces]
    pairs = zip([compensation.pattern * ALBEDO, *parts], [exact[0], *exact], strict=True)
    errors = [relative(part.reshape(-1, 3), truth) for part, truth in pairs]
    return Pictures(wanted, compensation.pattern, parts, errors)


def times(built: Built, wanted: np.ndarray) -> dict[str, float]:
    """Milliseconds of a product, of a solve and of the whole task."""
    pixels = wanted.reshape(-1, 3).astype(np.float32)
    R: Any = built.lighter.systems[0].R

    def solve() -> None:
        for c, S in enumerate(built.lighter.systems):
            ltcl.solve(S, pixels[:, c], rtol=ERROR)

    actions = {
        "product, on coefficients": product(R.core, np.zeros(R.core.shape[1], np.float32)),
        "product, in pixels": product(R, pixels[:, 0]),
        "solve in colour": solve,
        "compensate in colour": lambda: compensate(built, wanted),
    }
    return {name: 1e3 * spent for name, spent in seconds(actions).items()}


def claims(found: Pictures, ms: dict[str, float], smoke: bool) -> list[Claim]:
    """Errors of every picture, and time."""
    if smoke:
        return []
    names = ["pattern", "direct", *(f"bounce {k + 1}" for k in range(BOUNCES))]
    what, limit = "of 131072 pixels in colour", f"at most {ERROR:.0%}"
    of_errors = [
        Claim(f"{name} {what}", f"error {error:.2%}", limit, error <= ERROR)
        for name, error in zip(names, found.errors, strict=True)
    ]
    return of_errors + [
        Claim(f"{name}, 1 %", f"{ms[name]:.3g} ms", f"at most {most:g} ms", ms[name] <= most)
        for name, most in TARGETS.items()
    ]


def draw(found: Pictures) -> Figure:
    """The picture wanted, the pattern for it and where its light comes from."""
    figure = figures.page(
        270,
        "131072 pixels, each of which lights every other",
        "A picture on a corner of two walls, the pattern that makes it, and its light by bounces (4 times).",
    )
    walls = dihedral(2)
    lefts, width = figures.columns(3 + BOUNCES, gap=14)
    shown = [("wanted", found.wanted, 1.0), ("pattern", found.pattern, 0.6), ("direct", found.parts[0], 1.0)]
    shown += [(f"bounce {k + 1}", part, 4.0) for k, part in enumerate(found.parts[1:])]
    for left, (label, picture, gain) in zip(lefts, shown, strict=True):
        view = draw_view(walls.viewer, walls.walls, picture.astype(np.float32), 400, 2)
        figures.picture(figure, (left, 110, width), to_srgb(np.clip(gain * view, 0, 1)), label)
    return figure


def main() -> None:
    """Run it."""
    given = options(__doc__ or "")
    corner = Corner(Bounce(8 if given.smoke else 256, REFERENCE))
    built = build(given, corner)
    found = pictures(corner, built)
    ms = times(built, found.wanted)
    n = corner.rows.shape[0]
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
    claimed = claims(found, ms, given.smoke)
    figures.conclude(given, "131072 pixels in colour", claimed, facts, lambda: draw(found))


if __name__ == "__main__":
    main()
