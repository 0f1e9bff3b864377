# SPDX-License-Identifier: BSD-3-Clause
"""What pictures lose by a compression R~ = R + E: the largest of n losses, over fresh random pictures.

Light x loses ||E x|| / ||S x|| of its appearance S x = T p, and ||S~^-1 E x|| / ||x|| as a solution of
S x = b, direct light or a pattern before F^-1; the larger counts. In turn x = F p of a picture p, and
x = S~^-1 b, the light that makes the scene look like b. If a share s of all pictures loses no more than u, n
independent ones all do with probability s^n: at least the share (1 - confidence)^(1/n) loses no more than the
largest of n losses, with this confidence and whatever the distribution of losses is; with equal numbers of
each kind, too, as no product of shares is above the power of their mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ltcl.compression.norms import solve_columns
from ltcl.compression.sources import Problem
from ltcl.operators import IdentityPlus, Operator

COUNT, CONFIDENCE = 256, 0.99
_BLOCK = 64  # pictures at once
_RTOL = 3e-3  # of solves; each loss of a solution is widened by it


@dataclass(frozen=True)
class PictureError:
    """`error`, the largest of `count` losses; that of at least the `share` of pictures is no larger."""

    error: float
    share: float
    confidence: float
    count: int


def picture_error(
    problem: Problem, R: Operator, *, count: int = COUNT, seed: int = 0, confidence: float = CONFIDENCE
) -> PictureError:
    """What `count` fresh pictures lose by R~ in place of R; the seed must be new to R~."""
    random, errors, S = np.random.default_rng(seed), [0.0], IdentityPlus(R)
    for start in range(0, count, _BLOCK):
        x = draw(problem.grid, min(_BLOCK, count - start), random)
        x[:, ::2] *= (problem.F / np.max(problem.F))[:, None]
        x[:, 1::2] = solve_columns(S, x[:, 1::2], _RTOL)
        x = x[:, np.any(x, axis=0)].astype(np.float32)
        lost, exact = losses(problem, R, x)
        size = np.linalg.norm(x, axis=0)
        seen = np.linalg.norm(lost, axis=0) / np.maximum(np.linalg.norm(x + exact, axis=0), 1e-3 * size)
        solved = np.linalg.norm(solve_columns(S, lost, _RTOL), axis=0) / size
        errors += [*seen, *(solved * (1.0 + _RTOL))]
    return PictureError(float(np.max(errors)), (1.0 - confidence) ** (1.0 / count), confidence, count)


def losses(problem: Problem, R: Operator, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E x and R x of light x (N, k) in float64."""
    x = x.astype(np.float32)
    exact, compressed = (A.apply(A.device.upload(x)).get().astype(np.float64) for A in (problem.operator, R))
    return compressed - exact, exact


def typical_light(problem: Problem, count: int) -> np.ndarray:
    """Light F p (N, count) of norm 1, always of the same pictures: to choose by, not to confirm."""
    x = draw(problem.grid, count, np.random.default_rng(0)) * problem.F[:, None]
    return x / np.maximum(np.linalg.norm(x, axis=0), 1e-30)


def draw(grid: tuple[int, int], count: int, random: np.random.Generator) -> np.ndarray:
    """(N, count) random pictures of linear light up to 1, of each kind in turn."""
    kinds: tuple[Callable[..., np.ndarray], ...] = (_spectrum, _edges, _strokes, _patch)
    return np.stack([kinds[k // 2 % 4](grid, random).ravel() for k in range(count)], axis=1)


def _spectrum(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Of amplitudes 1 / f^a, a = 0.8 to 1.4, and log-normal values as of natural light."""
    y, x = np.fft.fftfreq(grid[0])[:, None], np.fft.rfftfreq(grid[1])
    f = np.maximum(np.hypot(y, x), 0.5 / max(grid))
    noise = np.fft.rfft2(random.standard_normal(grid)) * f ** -random.uniform(0.8, 1.4)
    values = np.fft.irfft2(noise, grid)
    values = np.exp(random.uniform(0.2, 1.0) * (values - values.mean()) / max(values.std(), 1e-9))
    return values / values.max()


def _edges(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Straight-edged surfaces of random grey and any direction, the later in front of the earlier."""
    y, x = np.mgrid[: grid[0], : grid[1]]
    picture = np.full(grid, random.random())
    for _ in range(random.integers(1, 24)):
        a, (v, u) = random.uniform(0, np.pi), random.uniform(0, 1, 2) * grid
        place = (x - u + 1j * (y - v)) * np.exp(1j * a)
        height, width = np.exp(random.uniform(math.log(0.02), 0.0, 2)) * max(grid)
        picture[(abs(place.imag) <= height) & (abs(place.real) <= width)] = random.random()
    return picture


def _strokes(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Lines of upright and level strokes, 1 or 2 pixels wide, as text: white on black, or dark on white."""
    letters, step = np.zeros(grid), int(random.integers(4, 9))
    for top in range(int(random.integers(step)), grid[0], step + 2):
        for left in range(int(random.integers(step)), grid[1], step):
            for _ in range(random.integers(0, 4)):
                (y, x), (h, w) = random.integers(0, step, 2), random.permutation([step, 1 + step // 6])
                letters[top + y : top + y + h, left + x : left + x + w] = 1.0
    ground, ink = (0.0, 1.0) if random.random() < 0.5 else (1.0, random.uniform(0.0, 0.3))
    return np.where(letters, ink, ground)


def _patch(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """One lit rectangle, of a single pixel in half of all pictures, and no other light."""
    picture = np.zeros(grid)
    sides = (1, 1) if random.random() < 0.5 else random.integers(1, np.maximum(2, np.array(grid) // 4 + 1))
    (y, x), (h, w) = random.integers(0, grid), sides
    picture[y : y + h, x : x + w] = 1.0
    return picture
