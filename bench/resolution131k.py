# SPDX-License-Identifier: BSD-3-Clause
"""The paper's resolution (figures 1 and 10): 131072 pixels, every one of which lights every other.

A coloured corner of two walls, 256 x 256 pixels each. R has 1.7e10 numbers none of which is small beside its
neighbours, 69 GB a colour, and is never formed:

    A     rows from closed-form form factors, thresholded between db2 wavelets as they stream by
    R     (I - A)^-1 - I by Chebyshev's form of eq. 21, on coefficients
    T     (I + R) F, solved on coefficients

A picture in colour is compensated and its bounces are separated to 1 %, the former with fewer numbers of R
(`_built.py`). The truth needs no inverse: of a picture l the direct light is l - A l, and bounce k + 1 is A
times bounce k. These products take all numbers of A, by a Fourier transform along the seam, and agree with
rows drawn at random to rounding.
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import _figures as figures
import ltcl
from _built import ALBEDO, ERROR, REFERENCE, SEPARATION, Built, Corner, build, wanted_picture
from _figures import Claim
from _harness import Options, options, seconds
from ltcl.images import to_srgb
from ltcl.operators import CSR, Compressed, Wavelet
from ltcl.scenes import CornerRows, dihedral
from ltcl.scenes.viewer import draw as draw_view

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BOUNCES, PROBES = 2, 64
PAPER_PRODUCT, PAPER_PICTURE = 33.0, 3000.0  # ms; of one colour channel
TARGETS = {"solve in colour": 5.0, "compensate in colour": 10.0}  # ms


def relative(found: np.ndarray, exact: np.ndarray) -> float:
    """Error of (N, 3) in the norm over pixels, of the worst colour."""
    return float(np.max(np.linalg.norm(found - exact, axis=0) / np.linalg.norm(exact, axis=0)))


def rows_at_random(given: Options, corner: Corner, built: Built, light: np.ndarray) -> tuple[float, float]:
    """Relative errors against rows of A drawn at random: of these as kept, and of the exact product."""
    W = Wavelet(given.device, corner.rows.grid, "db2")
    A = Compressed(CSR(given.device, built.A.core), W, W)
    which = np.sort(np.random.default_rng(7).choice(corner.pixels, min(PROBES, corner.pixels), replace=False))
    units = np.zeros((corner.pixels, len(which)), np.float32)
    units[which, np.arange(len(which))] = 1.0
    exact = np.concatenate([corner.rows.rows(int(i), int(i) + 1) for i in which])
    kept = np.linalg.norm(A.rmatmat(units).T - exact) / np.linalg.norm(exact)
    return float(kept), relative(corner.rows.matmat(light)[which], exact.astype(np.float64) @ light)


def residual_at_random(given: Options, corner: Corner, built: Built) -> float:
    """||(I + R)(I - A) v - v|| / ||v|| for random v, all of A, of the worst channel."""
    v = np.random.default_rng(8).standard_normal((corner.pixels, 3))
    left = v - corner.bounce(v)
    undone = np.stack([S.matvec(left[:, c]) for c, S in enumerate(built.T.systems)], axis=1)
    return relative(undone, v)


@dataclass(frozen=True)
class Pictures:
    """(h, w, 3) each; `exact` are the direct light and the bounces by all of A."""

    wanted: np.ndarray
    pattern: np.ndarray
    parts: list[np.ndarray]
    errors: list[float]


def pictures(corner: Corner, built: Built, spent: dict[str, float]) -> Pictures:
    """Compensate and separate a landscape, and compare with the truth."""
    wanted = wanted_picture(corner)
    flat = wanted.reshape(-1, 3)
    start = time.perf_counter()
    compensation = ltcl.compensate(built.lighter, wanted, bounds=(-10.0, 10.0), rtol=ERROR)
    spent["compensate, first call"] = time.perf_counter() - start
    start = time.perf_counter()
    separation = ltcl.separate(built.T, wanted, BOUNCES, rtol=SEPARATION)
    spent["separate, first call"] = time.perf_counter() - start
    exact = [corner.direct(flat)]
    for _ in range(BOUNCES):
        exact.append(corner.bounce(exact[-1]))
    found = [separation.direct, *separation.bounces]
    of_pattern = compensation.pattern.reshape(-1, 3) * np.array(ALBEDO)
    errors = [relative(of_pattern, exact[0])]
    errors += [relative(part.reshape(-1, 3), truth) for part, truth in zip(found, exact, strict=True)]
    return Pictures(wanted, compensation.pattern, found, errors)


def times(given: Options, built: Built, wanted: np.ndarray) -> dict[str, float]:
    """Milliseconds of a product, of a solve and of the whole task."""
    pixels = wanted.reshape(-1, 3).astype(np.float32)
    x = given.device.upload(pixels[:, 0])
    out = x.like()
    R: Any = built.lighter.systems[0].R
    a = given.device.upload(np.zeros(R.core.shape[1], np.float32))
    product_out = a.like()

    def in_pixels() -> None:
        R.apply(x, out)
        given.device.finish()

    def on_coefficients() -> None:
        R.core.apply(a, product_out)
        given.device.finish()

    def solve() -> None:
        for c, S in enumerate(built.lighter.systems):
            ltcl.solve(S, pixels[:, c], rtol=ERROR)

    actions: dict[str, Any] = {
        "product, on coefficients": on_coefficients,
        "product, in pixels": in_pixels,
        "solve in colour": solve,
        "compensate in colour": lambda: ltcl.compensate(
            built.lighter, wanted, bounds=(-10.0, 10.0), rtol=ERROR
        ),
    }
    return {name: 1e3 * spent for name, spent in seconds(actions).items()}


def claims(found: Pictures, ms: dict[str, float], smoke: bool) -> list[Claim]:
    """Errors of every picture, and time."""
    names = ["pattern", "direct", *(f"bounce {k + 1}" for k in range(BOUNCES))]
    limits = [ERROR, ERROR, *([ERROR] * BOUNCES)]
    of_errors = [
        Claim(
            f"{name} of 131072 pixels in colour", f"error {error:.2%}", f"at most {limit:.0%}", error <= limit
        )
        for name, error, limit in zip(names, found.errors, limits, strict=True)
    ]
    of_times = [
        Claim(f"{name}, 1 %", f"{ms[name]:.3g} ms", f"at most {most:g} ms", ms[name] <= most)
        for name, most in TARGETS.items()
    ]
    return [] if smoke else [*of_errors, *of_times]


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
    corner = Corner(CornerRows(8 if given.smoke else 256, REFERENCE))
    built = build(given, corner)
    found = pictures(corner, built, built.spent)
    ms = times(given, built, found.wanted)
    n = corner.pixels
    of_rows, of_product = rows_at_random(given, corner, built, found.wanted.reshape(-1, 3))
    facts: dict[str, Any] = {
        "pixels": n,
        "A, numbers a row": built.A.core.nnz / n,
        "A, dropped (Frobenius, at most)": built.A.dropped,
        "A, error of rows at random": of_rows,
        "exact product, apart from rows at random": of_product,
        "R, numbers a row": ", ".join(f"{one.D.nnz / n:.3g}" for one in built.R),
        "R, products of eq. 21": ", ".join(str(one.products) for one in built.R),
        "R, error of (I + R)(I - A~), bound": max(one.error for one in built.R),
        "R, error of (I + R)(I - A), probed": residual_at_random(given, corner, built),
        "R for patterns, numbers a row": ", ".join(f"{one.nnz / n:.3g}" for one in built.fewer),
        "bytes of T, for bounces and for patterns": f"{built.T.nbytes}, {built.lighter.nbytes}",
        "bytes of R, were it dense": 3 * 4 * n * n,
        **{f"{name}, s": spent for name, spent in built.spent.items()},
        **{f"{name}, ms": spent for name, spent in ms.items()},
        "the paper's product, ms": PAPER_PRODUCT,
        "the paper's compensation, ms": PAPER_PICTURE,
        "peak memory, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "largest buffer allowed, MB": given.device.max_allocation / 2**20,
    }
    figures.conclude(
        given, "131072 pixels in colour", claims(found, ms, given.smoke), facts, lambda: draw(found)
    )


if __name__ == "__main__":
    main()
