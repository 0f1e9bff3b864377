# SPDX-License-Identifier: BSD-3-Clause
"""What light loses by a compression R~ = R + E: any, by bounds on norms, and that of pictures.

`ltcl.theory.two_norm` needs an operator that was made without knowledge of its random start. So
every one that may be handed out is measured with a start of its own, and bound k may fail with miss
/ (k (k + 1)), which add up to `miss`. Starts are pseudo-random and always the same, so that results
have the same bits.

Light x loses ||E x|| / ||S x|| of its appearance S x = T p, and ||S~^-1 E x|| / ||x|| as a solution of
S x = b, direct light or a pattern before F^-1; the larger counts. In turn x = F p of a picture p,
and x = S~^-1 b, the light that makes the scene look like b. If a share s of all pictures loses no
more than u, n independent ones all do with probability s^n: at least the share (1 -
confidence)^(1/n) loses no more than the largest of n losses, with this confidence and whatever the
distribution of losses is; with equal numbers of each kind, too, as no product of shares is above
the power of their mean.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl.errors import ConvergenceError
from ltcl.operators import Compressed, Host, IdentityPlus, Operator
from ltcl.solvers import solve
from ltcl.tasks.compression.sources import Problem
from ltcl.theory.norms import CONFIDENCE, TwoNorm, two_norm

UNIT = 2.0**-24  # rounding of float32
MISS = 2e-6  # the chance that some bound of a compression, or of an inverse, fails
_PURPOSES = ("compress", "rewrite", "sparse inverse", "invert", "pictures")
_RTOL, _MAXITER = 1e-3, 400  # of the solves behind ||S^-1||
_STEPS = 8  # of the power iteration

COUNT, PICTURES = 256, 0.99  # of pictures, and of what is said of them the confidence
_BLOCK, _OF_PICTURES = 64, 3e-3  # at once; of solves, by which each loss of a solution is widened

Starts = Iterator[dict[str, Any]]
LinearOperator: Any = scipy.sparse.linalg.LinearOperator


def fresh_starts(purpose: str, miss: float = MISS) -> Starts:
    """`seed` and `confidence` of one bound after the other, as keywords of `two_norm`.

    What builds on each other takes starts of different `purpose`.
    """
    first = (1 + _PURPOSES.index(purpose)) << 32
    for k in itertools.count(1):
        yield {"seed": first + k, "confidence": 1.0 - miss / (k * (k + 1))}


def inverse_norm(
    S: IdentityPlus, *, confidence: float = CONFIDENCE, factor: float = 1.1, seed: int = 0
) -> TwoNorm:
    """||S^-1||_2 = 1 / smallest singular value of S = I + R, with an upper bound.

    Products with S^-1 and S^-T are solves. A solve to the relative residual t gives S^-1 (v - d)
    with ||d|| <= t ||v||: the steps see S^-1 + D, with ||D|| <= t sqrt(products) ||S^-1||, each
    right-hand side being orthogonal to those before, and the bound is widened by that.

    Between two equal orthonormal bases, the solves are with the core; options are those of
    `two_norm`. An S that is singular, or nearly so, raises ConvergenceError.

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> n = inverse_norm(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> round(n.estimate, 2), n.upper < 2.3  # eigenvalues of S are 1/2 and 3/2
    (2.0, True)
    """
    core = S.R.core if isinstance(S.R, Compressed) and S.R.two_sided else S.R
    times, transposed = (
        functools.partial(solve_columns, IdentityPlus(A, S.sign)) for A in (core, core.T)
    )
    inverse = LinearOperator(
        core.shape, times, transposed, times, dtype=np.float64, rmatmat=transposed
    )
    norm = two_norm(Host(core.device, inverse), confidence=confidence, factor=factor, seed=seed)
    upper = norm.upper / (1.0 - _RTOL * math.sqrt(norm.products))
    # Of some coefficients: S is the identity on the others.
    least = 1.0 if core.shape[0] < S.shape[0] else 0.0
    return replace(norm, estimate=max(norm.estimate, least), upper=max(upper, least))


def solve_columns(S: IdentityPlus, X: np.ndarray, rtol: float = _RTOL) -> np.ndarray:
    """S^-1 X in float64, or a ConvergenceError."""
    try:
        return np.asarray(solve(S, X, "gmres", rtol=rtol, maxiter=_MAXITER).x, np.float64)
    except ConvergenceError as error:
        left = f"a solve for the norm of its inverse left {error.solution.residual:.2g} of a light"
        message = f"S is singular, or nearly so: {left}; check the first bounce"
        raise ConvergenceError(message, error.solution) from None


def estimate_norm(A: Any, start: np.ndarray | None = None) -> tuple[float, np.ndarray]:
    """||A||_2 from below, by power iteration on the host, and the vector, a start for similar matrices."""
    AT, norm = A.T, 0.0
    v = np.random.default_rng(0).standard_normal(A.shape[1])
    if start is not None:  # a vector of an invariant subspace would never leave it
        v = start / np.linalg.norm(start) + 0.1 * v / np.linalg.norm(v)
    for _ in range(_STEPS):
        u = A @ (v / np.linalg.norm(v))
        norm, w = float(np.linalg.norm(u)), AT @ u
        if not 0.0 < float(np.linalg.norm(w)) < math.inf:
            break
        v = w
    return norm, v


@dataclass(frozen=True)
class PictureError:
    """`error`, the largest of `count` losses; that of at least the `share` of pictures is no larger."""

    error: float
    share: float
    confidence: float
    count: int


def picture_error(
    problem: Problem,
    R: Operator,
    *,
    count: int = COUNT,
    seed: int = 0,
    confidence: float = PICTURES,
) -> PictureError:
    """What `count` fresh pictures lose by R~ in place of R; the seed must be new to R~."""
    random, errors, S = np.random.default_rng(seed), [0.0], IdentityPlus(R)
    for start in range(0, count, _BLOCK):
        x = draw(problem.grid, min(_BLOCK, count - start), random)
        x[:, ::2] *= (problem.F / np.max(problem.F))[:, None]
        x[:, 1::2] = solve_columns(S, x[:, 1::2], _OF_PICTURES)
        x = x[:, np.any(x, axis=0)].astype(np.float32)
        dropped, exact = lost(problem, R, x)
        size = np.linalg.norm(x, axis=0)
        seen = np.linalg.norm(dropped, axis=0) / np.maximum(
            np.linalg.norm(x + exact, axis=0), 1e-3 * size
        )
        solved = np.linalg.norm(solve_columns(S, dropped, _OF_PICTURES), axis=0) / size
        errors += [*seen, *(solved * (1.0 + _OF_PICTURES))]
    return PictureError(
        float(np.max(errors)), (1.0 - confidence) ** (1.0 / count), confidence, count
    )


def lost(problem: Problem, R: Operator, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """E x and R x of light x (N, k) in float64."""
    x = x.astype(np.float32)
    exact, compressed = (
        A.apply(A.device.upload(x)).get().astype(np.float64) for A in (problem.operator, R)
    )
    return compressed - exact, exact


def typical_light(problem: Problem, count: int) -> np.ndarray:
    """Light F p (N, count) of norm 1, always of the same pictures: to choose by, not to confirm."""
    x = draw(problem.grid, count, np.random.default_rng(0)) * problem.F[:, None]
    return x / np.maximum(np.linalg.norm(x, axis=0), 1e-30)


def draw(grid: tuple[int, int], count: int, random: np.random.Generator) -> np.ndarray:
    """(N, count) random pictures of linear light up to 1, of each kind in turn."""
    kinds = (_spectrum, _edges, _strokes, _patch)
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
                (y, x), (h, w) = (
                    random.integers(0, step, 2),
                    random.permutation([step, 1 + step // 6]),
                )
                letters[top + y : top + y + h, left + x : left + x + w] = 1.0
    ground, ink = (0.0, 1.0) if random.random() < 0.5 else (1.0, random.uniform(0.0, 0.3))
    return np.where(letters, ink, ground)


def _patch(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """One lit rectangle, of a single pixel in half of all pictures, and no other light."""
    picture = np.zeros(grid)
    sides = (
        (1, 1)
        if random.random() < 0.5
        else random.integers(1, np.maximum(2, np.array(grid) // 4 + 1))
    )
    (y, x), (h, w) = random.integers(0, grid), sides
    picture[y : y + h, x : x + w] = 1.0
    return picture
