# SPDX-License-Identifier: BSD-3-Clause
"""Compression to what pictures need, judged by a second measurement and by pictures that it never saw.

The case: a box with two blocks, 64 x 64 pixels, path-traced (`scenes.tracing`), so that two
measurements differ by 19 % in the Frobenius norm of R and by 0.31 % in T p; and a simulated one,
four walls with a block, exact form factors, entries Poisson counts of as much noise. Then 200
pictures (parts of a photograph, letters, checkerboards, single pixels) in each of six scenes: the
largest loss of appearance, direct light and compensating pattern, over what is stated.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _coefficients import relative_error
from _figures import Claim
from _harness import parse_options
from ltcl import scenes
from ltcl.scenes.landscape import landscape
from scenes import tracing

FROBENIUS, HELD, ACCURATE = 0.19, 200, 1e-4
PATHS = 10_240  # a camera pixel, for such differences
LIMITS = (
    (0.01, "pictures", 150),
    ("noise", "pictures", 700),
    (0.1, "worst", None),
)  # bytes a row, at most
OVER = "worst held picture over stated, "


def box(n: int) -> np.ndarray:
    """T of four walls, n x n pixels each, two by two in a picture of 2 n x 2 n."""
    walls = np.arange(4 * n * n).reshape(n, 4, n)
    order = np.block([[walls[:, 0], walls[:, 1]], [walls[:, 2], walls[:, 3]]]).ravel()
    block = scenes.Block((0.3, 0.3, 0.0), (0.3, 0.3, 0.5))
    return (
        scenes.box(n, 4, albedo=0.28, occluder=block).transport().to_numpy()[np.ix_(order, order)]
    )


def measure(T: np.ndarray, grid: tuple[int, int]) -> list[ltcl.Transport]:
    """Two measurements with independent noise."""
    F, T = np.diagonal(T).astype(np.float64), T.astype(np.float64)
    R = np.maximum(T / F - np.eye(len(F)), 0.0)
    counts = 2.0 * R.sum() / (FROBENIUS * np.linalg.norm(R)) ** 2
    paths = (np.random.default_rng(seed).poisson(counts * R) / counts for seed in (1, 2))
    return [
        ltcl.Transport(((np.eye(len(F)) + each) * F).astype(np.float32), grid) for each in paths
    ]


def held(grid: tuple[int, int], count: int) -> np.ndarray:
    """Pictures (N, count), a quarter of each kind, none of which `compress` draws."""
    random, pictures, whole = np.random.default_rng(5), [], landscape(320, 512).mean(axis=2)
    h, w = grid
    for k in range(count):
        y, x, side = random.integers(0, 200), random.integers(0, 390), random.integers(40, 120)
        board = np.add.outer(np.arange(h) // (k % 7 + 1), np.arange(w) // (k % 5 + 1)) % 2
        page, word = np.zeros(grid, np.uint8), "".join(random.choice(list("abcdefgMNOPQ789"), 20))
        for line in range(9, h, 10):
            cv2.putText(
                page, word, (-int(random.integers(20)), line), cv2.FONT_HERSHEY_PLAIN, 0.7, (255,)
            )
        part = cv2.resize(whole[y : y + side, x : x + side], (w, h), interpolation=cv2.INTER_AREA)
        pixel = np.eye(1, h * w, int(random.integers(h * w))).reshape(grid)
        pictures.append((part, page / 255.0 if page.any() else board, board, pixel)[k % 4].ravel())
    return np.stack(pictures, axis=1)


def loss(T: ltcl.Transport, C: ltcl.Transport, count: int) -> float:
    """The largest of any held picture: of its light on the scene, and of light that shows it."""
    p = held(T.grid, count)
    (S,), approximate, direct = T.systems, C.systems[0].as_it_stands(), T.first_bounce[:, None] * p
    seen, b = S @ direct, p
    light, ours = (ltcl.solve(each, b, rtol=ACCURATE).x for each in (S, approximate))
    undone = ltcl.solve(approximate, seen, rtol=ACCURATE).x
    pairs = ((approximate @ direct, seen), (undone, direct), (ours, light), (S @ ours, b))
    return max(relative_error(*map(np.asarray, pair)) for pair in pairs)


def case(name: str, pair: list[ltcl.Transport], count: int) -> tuple[dict[str, Any], list[Claim]]:
    """What `compress` makes of the first of two measurements, judged by the second."""
    (T, other), claims = pair, []
    p = np.random.default_rng(3).random((len(T.first_bounce), 8)).astype(np.float32)
    R = [each.to_numpy() / each.first_bounce for each in pair]

    def off(C: ltcl.Transport) -> float:
        ours, exact = (np.asarray(A.operators[0] @ p).ravel() for A in (C, other))
        return relative_error(ours, exact)

    exact = off(T)
    differ = np.linalg.norm(R[1] - R[0]) / np.linalg.norm(R[0] - np.eye(len(p)))
    facts: dict[str, Any] = {f"{name}: two measurements": f"T p {exact:.3%}, R {differ:.1%}"}
    for rtol, norm, most in LIMITS:
        C = ltcl.compress(T, rtol, norm=norm)
        row, worst = C.compression.channels[0].nbytes / len(p), loss(T, C, count)
        facts[f"{name}: {rtol}, {norm}"] = (
            f"{row:.4g} bytes a row of {4 * len(p)}, stated {C.error:.3%}, bound {C.error_bound:.3%}, "
            f"measured {off(C):.3%}, worst held picture {worst:.3%}, {C.compression.seconds:.3g} s"
        )
        facts[f"{OVER}{name}, {rtol}, {norm}"] = worst / C.error
        if most:
            text = f"{name}: bytes a row at rtol {rtol}"
            claims.append(Claim(text, f"{row:.4g}", f"at most {most}", row <= most))
        if rtol == "noise":
            text, ratio = (
                f"{name}: appearance error over that of the exact T, noise",
                off(C) / exact,
            )
            claims.append(Claim(text, f"{ratio:.3f}", "at most 1.1", ratio <= 1.1))
    return facts, claims


def main() -> None:
    """Run it."""
    given = parse_options(__doc__ or "")
    n, small, count = (8, 6, 16) if given.smoke else (32, 16, HELD)
    others = {
        "corner": scenes.dihedral(small, albedo=0.6),
        "painted": scenes.trihedral(small, albedo=[[0.9], [0.3], [0.6]]),
        "room": scenes.box(small, 3, albedo=0.7),
        "closed": scenes.box(small // 2, 6, albedo=0.5),
    }
    pairs, facts, claims = {"simulated": measure(box(n), (2 * n, 2 * n))}, {}, []
    if why := "--smoke" if given.smoke else tracing.unavailable():
        facts["path-traced"] = f"not measured: {why}"
    else:
        traced = (tracing.trace("blocks", (64, 64), PATHS, seed).sum(axis=0) for seed in (1, 2))
        pairs["path-traced"] = [ltcl.Transport(T, (64, 64)) for T in traced]
    for name, pair in pairs.items():
        more, further = case(name, pair, count)
        facts, claims = facts | more, claims + further * (not given.smoke)
    for name, scene in others.items():
        T, _ = measure(scene.transport().to_numpy(), scene.grid)
        C = ltcl.compress(T, 0.01)
        facts[OVER + name] = loss(T, C, count) / C.error
    largest = max(ratio for name, ratio in facts.items() if name.startswith(OVER))
    text = f"held pictures over what is stated, {count} in {len(pairs) + len(others)} scenes"
    claims.append(Claim(text, f"{largest:.3f}", "at most 1.5", largest <= 1.5))
    figures.conclude(given, "Compression to what pictures need", claims, facts, Figure)


if __name__ == "__main__":
    main()
