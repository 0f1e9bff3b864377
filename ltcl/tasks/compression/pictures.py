# SPDX-License-Identifier: BSD-3-Clause
"""Losses of pictures by a compression R~ = R + E, of random pictures of four kinds.

Light x loses ||E x|| / ||S x|| of its appearance S x = T p, and ||S~^-1 E x|| / ||x|| as a
solution of S x = b, direct light or a pattern before F^-1; the larger counts. In turn x = F p of a
picture p, and x = S~^-1 b, the light that makes the scene look like b.

If a share s of all pictures loses no more than u, n independent ones all do with probability s^n:
at least the share (1 - confidence)^(1/n) loses no more than the largest of n losses, with this
confidence and whatever the distribution of losses is; with equal numbers of each kind, too, as no
product of shares is above the power of their mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ltcl.operators import IdentityPlus, Operator
from ltcl.tasks.compression.inputs import CompressionProblem
from ltcl.tasks.compression.norms import solve_columns

# Pictures that confirm an error, and the confidence of what is said of them. One draw of so many
# speaks of 0.01^(1/256) = 98.2 % of all pictures. Draw k has the confidence 1 - 0.01 / (k (k + 1)),
# so that all together keep 99 %; the 24th, the last of three channels and eight thresholds each,
# still speaks of 95.8 %.
PICTURE_COUNT = 256
PICTURE_CONFIDENCE = 0.99
PICTURES_AT_ONCE = 64
# Tolerance of the solves, by which each loss of a solution is widened.
SOLVE_RTOL = 3e-3
# Appearances below this part of the light count as that much.
MIN_APPEARANCE = 1e-3


@dataclass(frozen=True)
class PictureError:
    """`error`, the largest of `count` losses; at least the `share` of pictures loses no more."""

    error: float
    share: float
    confidence: float
    count: int


def picture_error(
    problem: CompressionProblem,
    R: Operator,
    *,
    count: int = PICTURE_COUNT,
    seed: int = 0,
    confidence: float = PICTURE_CONFIDENCE,
) -> PictureError:
    """Largest loss of `count` fresh pictures by R~ in place of R; the seed must be new to R~."""
    random = np.random.default_rng(seed)
    S = IdentityPlus(R)
    errors = [0.0]
    for start in range(0, count, PICTURES_AT_ONCE):
        x = draw(problem.grid, min(PICTURES_AT_ONCE, count - start), random)
        # Pictures in turn as patterns and as targets.
        x[:, ::2] *= (problem.F / np.max(problem.F))[:, None]
        x[:, 1::2] = solve_columns(S, x[:, 1::2], SOLVE_RTOL)
        is_lit = np.any(x, axis=0)
        x = x[:, is_lit].astype(np.float32)
        lost, exact = lost_light(problem, R, x)
        size = np.linalg.norm(x, axis=0)
        appearance = np.linalg.norm(x + exact, axis=0)
        appearance = np.maximum(appearance, MIN_APPEARANCE * size)
        errors += list(np.linalg.norm(lost, axis=0) / appearance)
        solved = solve_columns(S, lost, SOLVE_RTOL)
        relative = np.linalg.norm(solved, axis=0) / size
        errors += list(relative * (1.0 + SOLVE_RTOL))
    share = (1.0 - confidence) ** (1.0 / count)
    return PictureError(float(np.max(errors)), share, confidence, count)


def lost_light(
    problem: CompressionProblem, R: Operator, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """E x and R x of light x (N, k) in float64."""
    x = x.astype(np.float32)
    exact = _product(problem.operator, x)
    return _product(R, x) - exact, exact


def _product(A: Operator, x: np.ndarray) -> np.ndarray:
    return A.apply(A.device.upload(x)).get().astype(np.float64)


def typical_light(problem: CompressionProblem, count: int) -> np.ndarray:
    """Light F p (N, count) of norm 1, always of the same pictures: to choose by, not to confirm."""
    pictures = draw(problem.grid, count, np.random.default_rng(0))
    x = pictures * problem.F[:, None]
    return x / np.maximum(np.linalg.norm(x, axis=0), 1e-30)


def draw(grid: tuple[int, int], count: int, random: np.random.Generator) -> np.ndarray:
    """(N, count) random pictures of linear light up to 1, two of each kind in turn."""
    kinds = (_spectrum, _edges, _strokes, _patch)
    pictures = []
    for number in range(count):
        kind = kinds[number // 2 % len(kinds)]
        pictures.append(kind(grid, random).ravel())
    return np.stack(pictures, axis=1)


def _spectrum(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Picture of amplitudes 1 / f^a, a = 0.8 to 1.4, and log-normal values like natural light."""
    y = np.fft.fftfreq(grid[0])[:, None]
    x = np.fft.rfftfreq(grid[1])
    f = np.maximum(np.hypot(y, x), 0.5 / max(grid))
    noise = np.fft.rfft2(random.standard_normal(grid))
    noise = noise * f ** -random.uniform(0.8, 1.4)
    values = np.fft.irfft2(noise, grid)
    contrast = random.uniform(0.2, 1.0)
    deviation = max(values.std(), 1e-9)
    values = np.exp(contrast * (values - values.mean()) / deviation)
    return values / values.max()


def _edges(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Straight-edged surfaces of random grey and direction, later ones in front of earlier ones."""
    y, x = np.mgrid[: grid[0], : grid[1]]
    picture = np.full(grid, random.random())
    for _ in range(random.integers(1, 24)):
        angle = random.uniform(0, np.pi)
        v, u = random.uniform(0, 1, 2) * grid
        place = (x - u + 1j * (y - v)) * np.exp(1j * angle)
        sides = np.exp(random.uniform(math.log(0.02), 0.0, 2))
        height, width = sides * max(grid)
        is_inside = (abs(place.imag) <= height) & (abs(place.real) <= width)
        picture[is_inside] = random.random()
    return picture


def _strokes(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Lines of upright and level strokes, 1 or 2 pixels wide, like text: white or dark."""
    letters = np.zeros(grid)
    step = int(random.integers(4, 9))
    for top in range(int(random.integers(step)), grid[0], step + 2):
        for left in range(int(random.integers(step)), grid[1], step):
            for _ in range(random.integers(0, 4)):
                y, x = random.integers(0, step, 2)
                h, w = random.permutation([step, 1 + step // 6])
                letters[top + y : top + y + h, left + x : left + x + w] = 1.0
    is_white_on_black = random.random() < 0.5
    if is_white_on_black:
        return np.where(letters, 1.0, 0.0)
    return np.where(letters, random.uniform(0.0, 0.3), 1.0)


def _patch(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Lit rectangle, a single pixel in half of all pictures, and no other light."""
    picture = np.zeros(grid)
    is_single_pixel = random.random() < 0.5
    if is_single_pixel:
        h, w = 1, 1
    else:
        h, w = random.integers(1, np.maximum(2, np.array(grid) // 4 + 1))
    y, x = random.integers(0, grid)
    picture[y : y + h, x : x + w] = 1.0
    return picture
