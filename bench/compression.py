# SPDX-License-Identifier: BSD-3-Clause
"""Compression to what pictures need, judged by a second measurement and by pictures that it never saw.

The case: a box with two blocks, 64 x 64 pixels, path-traced (`_traced`), so that two measurements differ by
19 % in the Frobenius norm of R and by 0.31 % in T p; and a simulated one, four walls with a block, exact form
factors, entries Poisson counts of as much noise. Then 200 pictures (parts of a photograph, letters,
checkerboards, single pixels) in each of six scenes: the largest loss of appearance, direct light and
compensating pattern, over what is stated.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import _traced
import ltcl
from _figures import Claim
from _harness import options
from ltcl import scenes
from ltcl.scenes.landscape import landscape

ALBEDO, FROBENIUS, HELD, ACCURATE = 0.28, 0.19, 200, 1e-4
PATHS = 10_240  # a camera pixel, for such differences
LEAST, MOST = 150, 700  # bytes a row: of rtol 0.01, of "noise"
BLOCK = scenes.Block((0.3, 0.3, 0.0), (0.3, 0.3, 0.5))
Measured = tuple[ltcl.Transport, ltcl.Transport]


def box(n: int) -> np.ndarray:
    """T of four walls, n x n pixels each, two by two in a picture of 2 n x 2 n."""
    walls = np.arange(4 * n * n).reshape(n, 4, n)
    order = np.block([[walls[:, 0], walls[:, 1]], [walls[:, 2], walls[:, 3]]]).ravel()
    T = scenes.box(n, 4, albedo=ALBEDO, occluder=BLOCK).transport().to_numpy()
    return T[np.ix_(order, order)].astype(np.float64)


def measure(T: np.ndarray, grid: tuple[int, int]) -> Measured:
    """Two measurements with independent noise."""
    F = np.diagonal(T).copy()
    R = np.maximum(T / F - np.eye(len(F)), 0.0)
    counts = 2.0 * R.sum() / (FROBENIUS * np.linalg.norm(R)) ** 2

    def measurement(seed: int) -> ltcl.Transport:
        paths = np.random.default_rng(seed).poisson(counts * R)
        return ltcl.Transport(((np.eye(len(F)) + paths / counts) * F).astype(np.float32), grid)

    return measurement(1), measurement(2)


def held(grid: tuple[int, int], count: int) -> np.ndarray:
    """Pictures (N, count), a quarter of each kind, none of which `compress` draws."""
    random, pictures, whole = np.random.default_rng(5), [], landscape(320, 512).mean(axis=2)
    h, w = grid
    for k in range(count):
        y, x, side = random.integers(0, 200), random.integers(0, 390), random.integers(40, 120)
        board = np.add.outer(np.arange(h) // (k % 7 + 1), np.arange(w) // (k % 5 + 1)) % 2
        page, word = np.zeros(grid, np.uint8), "".join(random.choice(list("abcdefgMNOPQ789"), 20))
        for line in range(9, h, 10):
            cv2.putText(page, word, (-int(random.integers(20)), line), cv2.FONT_HERSHEY_PLAIN, 0.7, (255,))
        part = cv2.resize(whole[y : y + side, x : x + side], (w, h), interpolation=cv2.INTER_AREA)
        pixel = np.eye(1, h * w, int(random.integers(h * w))).reshape(grid)
        pictures.append((part, page / 255.0 if page.any() else board, board, pixel)[k % 4].ravel())
    return np.stack(pictures, axis=1)


def size(x: Any) -> np.ndarray:
    return np.linalg.norm(np.asarray(x, np.float64), axis=0)


def losses(T: ltcl.Transport, C: ltcl.Transport, p: np.ndarray) -> np.ndarray:
    """Of each picture (N, k) the largest loss: of its light on the scene, and of light that shows it."""
    (S,), approximate, direct = T.systems, C.systems[0].as_it_stands(), T.first_bounce[:, None] * p
    seen, b = S @ direct, p
    light, ours = (ltcl.solve(each, b, rtol=ACCURATE).x for each in (S, approximate))
    undone = ltcl.solve(approximate, seen, rtol=ACCURATE).x
    pairs = ((approximate @ direct, seen), (undone, direct), (ours, light), (S @ ours, b))
    return np.max([size(a - exact) / size(exact) for a, exact in pairs], axis=0)


def case(name: str, pair: Measured, count: int, smoke: bool) -> tuple[dict[str, Any], list[Claim]]:
    """What `compress` makes of the first of two measurements, judged by the second."""
    (T, other), claims = pair, []
    p = np.random.default_rng(3).random((len(T.first_bounce), 8)).astype(np.float32)
    truth, R = np.asarray(other.operators[0] @ p), [each.to_numpy() / each.first_bounce for each in pair]

    def off(C: ltcl.Transport) -> float:
        return float(size((np.asarray(C.operators[0] @ p) - truth).ravel()) / size(truth.ravel()))

    exact = off(T)
    differ = np.linalg.norm(R[1] - R[0]) / np.linalg.norm(R[0] - np.eye(len(p)))
    facts: dict[str, Any] = {f"{name}: two measurements": f"T p {exact:.3%}, R {differ:.1%}"}
    for rtol, norm in ((0.01, "pictures"), ("noise", "pictures"), (0.1, "worst")):
        C = ltcl.compress(T, rtol, norm=norm)
        report = C.compression
        row, worst = report.channels[0].nbytes / len(p), float(losses(T, C, held(T.grid, count)).max())
        facts[f"{name}: {rtol}, {norm}"] = (
            f"{row:.4g} bytes a row of {4 * len(p)}, stated {C.error:.3%}, bound {C.error_bound:.3%}, "
            f"measured {off(C):.3%}, worst held picture {worst:.3%}, {report.seconds:.3g} s"
        )
        facts[over(f"{name}, {rtol}, {norm}")] = worst / C.error
        limit = {0.01: LEAST, "noise": MOST}.get(rtol)
        if limit and not smoke:
            text = f"{name}: bytes a row at rtol {rtol}"
            claims.append(Claim(text, f"{row:.4g}", f"at most {limit}", row <= limit))
        if rtol == "noise" and not smoke:
            text, ratio = f"{name}: appearance error over that of the exact T, noise", off(C) / exact
            claims.append(Claim(text, f"{ratio:.3f}", "at most 1.1", ratio <= 1.1))
    return facts, claims


def over(what: str) -> str:
    """Name of a fact."""
    return f"worst held picture over stated, {what}"


def main() -> None:
    """Run it."""
    given = options(__doc__ or "")
    n, small, count = (8, 6, 16) if given.smoke else (32, 16, HELD)
    corner, room = scenes.dihedral(small, albedo=0.6), scenes.box(small, 3, albedo=0.7)
    painted = scenes.trihedral(small, albedo=[[0.9], [0.3], [0.6]])
    closed = scenes.box(small // 2, 6, albedo=0.5)
    pairs, facts, claims = {"simulated": measure(box(n), (2 * n, 2 * n))}, {}, []
    if why := "--smoke" if given.smoke else _traced.unavailable():
        facts["path-traced"] = f"not measured: {why}"
    else:
        first, second = (_traced.trace("blocks", (64, 64), PATHS, seed).sum(axis=(0, 1)) for seed in (1, 2))
        pairs["path-traced"] = ltcl.Transport(first, (64, 64)), ltcl.Transport(second, (64, 64))
    for name, pair in pairs.items():
        more, further = case(name, pair, count, given.smoke)
        facts, claims = facts | more, claims + further
    for name, scene in {"corner": corner, "painted": painted, "room": room, "closed": closed}.items():
        T, _ = measure(scene.transport().to_numpy().astype(np.float64), scene.grid)
        C, bound = (ltcl.compress(T, 0.01, norm=norm) for norm in ("pictures", "worst"))
        facts[over(name)] = float(losses(T, C, held(T.grid, count)).max()) / C.error
        faster = C.compression.seconds / bound.compression.seconds
        facts[f"{name}, over those of the bound"] = f"{C.nbytes / bound.nbytes:.2g} bytes, {faster:.2g} time"
    largest = max(ratio for name, ratio in facts.items() if name.startswith(over("")))
    text = f"held pictures over what is stated, {count} in {len(pairs) + 4} scenes"
    claims.append(Claim(text, f"{largest:.3f}", "at most 1.5", largest <= 1.5))
    figures.conclude(given, "Compression to what pictures need", claims, facts, Figure)


if __name__ == "__main__":
    main()
