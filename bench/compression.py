# SPDX-License-Identifier: BSD-3-Clause
"""Compression as far as pictures allow, judged by a second measurement and by unseen pictures.

The case: a box with two blocks, 64 x 64 pixels, path-traced (`scenes.tracing`), so that two
measurements differ by 19 % in the Frobenius norm of R and by 0.31 % in T p; and a simulated one,
four walls with a block, exact form factors, entries Poisson counts of as much noise. Then 200
pictures (parts of a photograph, letters, checkerboards, single pixels) in each of six scenes: the
largest loss of appearance, direct light and compensating pattern, over the stated error.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _coefficients import relative_error
from _figures import Claim
from _harness import parse_options
from ltcl import Transport, scenes
from ltcl.scenes.landscape import landscape
from scenes import tracing

# Difference of two measurements, in the Frobenius norm of R.
FROBENIUS = 0.19
# Tolerance of the solves of held pictures.
ACCURATE = 1e-4
# Paths a camera pixel, for such differences.
PATHS = 10_240
# Tolerance, norm, and most bytes a row.
LIMITS = (
    (0.01, "pictures", 150),
    ("noise", "pictures", 700),
    (0.1, "worst", None),
)
OVER = "worst held picture over stated, "


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Pixels along a wall of the simulated box and of other scenes, and number of pictures."""

    box: int = 32
    others: int = 16
    pictures: int = 200


SMOKE_SIZES = Sizes(box=8, others=6, pictures=16)


def box(n: int) -> np.ndarray:
    """T of four walls, n x n pixels each, two by two in a picture of 2 n x 2 n."""
    walls = np.arange(4 * n * n).reshape(n, 4, n)
    order = np.block([[walls[:, 0], walls[:, 1]], [walls[:, 2], walls[:, 3]]]).ravel()
    block = scenes.Block((0.3, 0.3, 0.0), (0.3, 0.3, 0.5))
    T = scenes.box(n, 4, albedo=0.28, occluder=block).transport()
    return T.to_numpy()[np.ix_(order, order)]


def measure(T: np.ndarray, grid: tuple[int, int]) -> list[Transport]:
    """Two measurements with independent noise."""
    F = np.diagonal(T).astype(np.float64)
    identity = np.eye(len(F))
    R = np.maximum(T.astype(np.float64) / F - identity, 0.0)
    counts = 2.0 * R.sum() / (FROBENIUS * np.linalg.norm(R)) ** 2
    measurements = []
    for seed in (1, 2):
        noisy = np.random.default_rng(seed).poisson(counts * R) / counts
        entries = ((identity + noisy) * F).astype(np.float32)
        measurements.append(Transport(entries, grid))
    return measurements


def held_pictures(grid: tuple[int, int], count: int) -> np.ndarray:
    """Pictures (N, count), a quarter of each kind, none of which `compress` draws."""
    random = np.random.default_rng(5)
    photograph = landscape(320, 512).mean(axis=2)
    pictures = []
    for number in range(count):
        # All kinds are drawn for each picture, so that its random numbers do not depend on others.
        part = _part(photograph, grid, random)
        board = _checkerboard(grid, number)
        page = _page(grid, random)
        if not page.any():
            page = board
        pixel = np.zeros(page.size)
        pixel[random.integers(page.size)] = 1.0
        kinds = (part, page, board, pixel)
        pictures.append(kinds[number % 4].ravel())
    return np.stack(pictures, axis=1)


def _part(photograph: np.ndarray, grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Cut a square of a photograph, resized."""
    h, w = grid
    y = random.integers(0, 200)
    x = random.integers(0, 390)
    side = random.integers(40, 120)
    square = photograph[y : y + side, x : x + side]
    return cv2.resize(square, (w, h), interpolation=cv2.INTER_AREA)


def _checkerboard(grid: tuple[int, int], number: int) -> np.ndarray:
    """Draw a board whose squares differ with its number."""
    h, w = grid
    rows = np.arange(h) // (number % 7 + 1)
    columns = np.arange(w) // (number % 5 + 1)
    return np.add.outer(rows, columns) % 2


def _page(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Draw a word of 20 letters on all lines that the grid has room for."""
    page = np.zeros(grid, np.uint8)
    word = "".join(random.choice(list("abcdefgMNOPQ789"), 20))
    for line in range(9, grid[0], 10):
        start = (-int(random.integers(20)), line)
        cv2.putText(page, word, start, cv2.FONT_HERSHEY_PLAIN, 0.7, (255,))
    return page / 255.0


def picture_loss(T: Transport, C: Transport, count: int) -> float:
    """Largest error of any held picture: of its light on the scene, and of light that shows it."""
    (S,) = T.systems
    approximate = C.systems[0].as_it_stands()
    pictures = held_pictures(T.grid, count)
    direct = T.first_bounce[:, None] * pictures
    appearance = S @ direct
    # Direct light that shows the pictures, by both systems.
    needed = ltcl.solve(S, pictures, rtol=ACCURATE).x
    shown = ltcl.solve(approximate, pictures, rtol=ACCURATE).x
    undone = ltcl.solve(approximate, appearance, rtol=ACCURATE).x
    pairs = [
        (approximate @ direct, appearance),
        (undone, direct),
        (shown, needed),
        (S @ shown, pictures),
    ]
    return max(itertools.starmap(relative_error, pairs))


class Case:
    """Compression of the first of two measurements, judged by the second."""

    def __init__(self, name: str, pair: list[Transport], pictures: int) -> None:
        self.name = name
        self.T, self.second = pair
        self.pictures = pictures
        self.pixels = len(self.T.first_bounce)
        random = np.random.default_rng(3)
        self.patterns = random.random((self.pixels, 8)).astype(np.float32)
        self.facts: dict[str, Any] = {}
        self.claims: list[Claim] = []

    def run(self) -> None:
        """Compress by all limits, and collect facts and claims."""
        exact_error = self.pattern_error(self.T)
        first_R = self.T.to_numpy() / self.T.first_bounce
        second_R = self.second.to_numpy() / self.second.first_bounce
        bounces = np.linalg.norm(first_R - np.eye(self.pixels))
        difference = np.linalg.norm(second_R - first_R) / bounces
        text = f"T p {exact_error:.3%}, R {difference:.1%}"
        self.facts[f"{self.name}: two measurements"] = text
        for rtol, norm, most_bytes in LIMITS:
            C = ltcl.compress(self.T, rtol, norm=norm)
            bytes_a_row = C.compression.channels[0].nbytes / self.pixels
            error = self.pattern_error(C)
            self._add_facts(f"{rtol}, {norm}", C, bytes_a_row, error)
            if most_bytes is not None:
                self._claim_size(rtol, bytes_a_row, most_bytes)
            if rtol == "noise":
                self._claim_accuracy(error / exact_error)

    def pattern_error(self, T: Transport) -> float:
        """Relative error of T p, beside the second measurement."""
        ours = np.asarray(T.operators[0] @ self.patterns).ravel()
        exact = np.asarray(self.second.operators[0] @ self.patterns).ravel()
        return relative_error(ours, exact)

    def _add_facts(self, limit: str, C: Transport, bytes_a_row: float, error: float) -> None:
        worst = picture_loss(self.T, C, self.pictures)
        sizes = f"{bytes_a_row:.4g} bytes a row of {4 * self.pixels}"
        errors = f"stated {C.error:.3%}, bound {C.error_bound:.3%}, measured {error:.3%}"
        seconds = f"{C.compression.seconds:.3g} s"
        self.facts[f"{self.name}: {limit}"] = (
            f"{sizes}, {errors}, worst held picture {worst:.3%}, {seconds}"
        )
        self.facts[f"{OVER}{self.name}, {limit}"] = worst / C.error

    def _claim_size(self, rtol: Any, bytes_a_row: float, most_bytes: int) -> None:
        claim = Claim(
            text=f"{self.name}: bytes a row at rtol {rtol}",
            measured=f"{bytes_a_row:.4g}",
            wanted=f"at most {most_bytes}",
            holds=bytes_a_row <= most_bytes,
        )
        self.claims.append(claim)

    def _claim_accuracy(self, ratio: float) -> None:
        claim = Claim(
            text=f"{self.name}: appearance error over that of the exact T, noise",
            measured=f"{ratio:.3f}",
            wanted="at most 1.1",
            holds=ratio <= 1.1,
        )
        self.claims.append(claim)


def measured_pairs(n: int, why_not_traced: str) -> dict[str, list[Transport]]:
    """Two measurements of a simulated box, and of a path-traced one if it can be traced."""
    pairs = {"simulated": measure(box(n), (2 * n, 2 * n))}
    if not why_not_traced:
        grid = (64, 64)
        transports = []
        for seed in (1, 2):
            T = tracing.trace("blocks", grid, PATHS, seed).sum(axis=0)
            transports.append(Transport(T, grid))
        pairs["path-traced"] = transports
    return pairs


def other_scenes(n: int) -> dict[str, scenes.Scene]:
    """Scenes whose pictures are judged as well."""
    return {
        "corner": scenes.dihedral(n, albedo=0.6),
        "painted": scenes.trihedral(n, albedo=[[0.9], [0.3], [0.6]]),
        "room": scenes.box(n, 3, albedo=0.7),
        "closed": scenes.box(n // 2, 6, albedo=0.5),
    }


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    if options.smoke:
        sizes = SMOKE_SIZES
        why_not_traced = "--smoke"
    else:
        sizes = Sizes()
        why_not_traced = tracing.unavailable()
    pairs = measured_pairs(sizes.box, why_not_traced)
    others = other_scenes(sizes.others)
    facts: dict[str, Any] = {}
    claims: list[Claim] = []
    if why_not_traced:
        facts["path-traced"] = f"not measured: {why_not_traced}"
    for name, pair in pairs.items():
        case = Case(name, pair, sizes.pictures)
        case.run()
        facts |= case.facts
        # Limits are those of the full size.
        if not options.smoke:
            claims += case.claims
    for name, scene in others.items():
        T, _ = measure(scene.transport().to_numpy(), scene.grid)
        C = ltcl.compress(T, 0.01)
        facts[OVER + name] = picture_loss(T, C, sizes.pictures) / C.error
    largest = max(ratio for name, ratio in facts.items() if name.startswith(OVER))
    count = len(pairs) + len(others)
    claim = Claim(
        text=f"held pictures over what is stated, {sizes.pictures} in {count} scenes",
        measured=f"{largest:.3f}",
        wanted="at most 1.5",
        holds=largest <= 1.5,
    )
    claims.append(claim)
    title = "Compression to what pictures need"
    figures.conclude(options, title, claims, facts, Figure)


if __name__ == "__main__":
    main()
