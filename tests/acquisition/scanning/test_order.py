# SPDX-License-Identifier: BSD-3-Clause
"""Pictures in another order than their patterns are refused; those of scenes in order never are."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.scanning import columns, order
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture
from ltcl.errors import AcquisitionError

from .helpers import corner

NOISES = [(1e-5, 1e9), (0.003, 1e4), (0.02, 1e3), (0.1, 100.0), (1.0, 10.0)]
"""Read noise, where white is about 1, and electrons."""
STRATEGIES = ("pixel", "hadamard")


@cache
def scene(name: str) -> tuple[np.ndarray, tuple[int, int]]:
    """T (channels, M, N), float64, and its grid."""
    if name == "half a pixel beside":
        T, (h, w) = corner(8), (8, 16)
        right = np.minimum(np.arange(w) + 1, w - 1) + w * np.arange(h)[:, None]
        return (0.55 * T + 0.45 * T[:, right.ravel()])[None], (h, w)
    made = {
        "corner": lambda: ltcl.scenes.dihedral(8, albedo=0.6),
        "narrow corner": lambda: ltcl.scenes.dihedral(8, albedo=0.9, angle=30),
        "small": lambda: ltcl.scenes.dihedral(2, albedo=0.9),
        "three walls": lambda: ltcl.scenes.trihedral(5, albedo=0.9),
        "box": lambda: ltcl.scenes.box(5, sides=5, albedo=0.9),
        "colours": lambda: ltcl.scenes.dihedral(6, albedo=(0.9, 0.5, 0.1)),
    }[name]()
    T = made.transport()
    return np.stack([np.asarray(part, np.float64) for part in T.matrices]), T.grid


SCENES = ("corner", "narrow corner", "small", "three walls", "box", "half a pixel beside")


def batches(strategy: str, grid: tuple[int, int]) -> Iterator[np.ndarray]:
    """Patterns (k, N) of each batch."""
    code, n = columns.code_of(strategy, grid, 63), grid[0] * grid[1]
    for start in range(0, n, code.size):
        on = code.patterns(min(code.size, n - start))
        yield np.pad(on.astype(float), ((0, 0), (start, n - start - on.shape[1])))


class Camera:
    """Pictures of T with noise, and one error of the ambient light in all of them."""

    def __init__(self, T: np.ndarray, sigma: float, electrons: float, seed: int) -> None:
        self.T, self.sigma, self.electrons = T, sigma, electrons
        self.rng = np.random.default_rng(seed)
        self.ambient = np.full(T.shape[:2], (0.25 * sigma) ** 2)
        self.error = 0.25 * sigma * self.rng.standard_normal(T.shape[:2])
        w = T.sum(axis=2)
        v = (sigma**2 + w / electrons) / 16
        self.white = Picture(w + np.sqrt(v) * self.rng.standard_normal(w.shape), v)

    def check(self, named: np.ndarray, lit: np.ndarray) -> None:
        """Pictures of some patterns, said to be of others."""
        y = np.einsum("cmn,kn->kcm", self.T, lit)
        v = self.sigma**2 + y / self.electrons
        y = y + np.sqrt(v) * self.rng.standard_normal(y.shape) + self.error
        y, v = y.astype(np.float32), v.astype(np.float32)
        order.check(named, y, v, self.ambient, self.white, "photograph {}".format)


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("name", [*SCENES, "colours"])
def test_no_scene_in_order_is_refused(name: str, strategy: str, caplog: pytest.LogCaptureFixture) -> None:
    T, grid = scene(name)
    for seed, noise in enumerate(NOISES * 4):
        camera = Camera(T, *noise, seed)
        for patterns in batches(strategy, grid):
            camera.check(patterns, patterns)
    assert not caplog.records


def exchanged(rng: np.random.Generator, k: int) -> np.ndarray:
    found = np.arange(k)
    some = rng.choice(k, 2, replace=False)
    found[some] = found[some[::-1]]
    return found


WRONG: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "two exchanged": exchanged,
    "reversed": lambda rng, k: np.arange(k)[::-1],
    "one late": lambda rng, k: np.append(0, np.arange(k - 1)),
    "one early": lambda rng, k: np.append(np.arange(1, k), 0),
    "in any order": lambda rng, k: rng.permutation(k),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("noise", NOISES[1:3])
def test_another_order_is_refused(strategy: str, wrong: str, noise: tuple[float, float]) -> None:
    """By the numbers of the photographs that are wrong, and of no other."""
    T, grid = scene("corner")
    patterns = next(batches(strategy, grid))
    for seed in range(6):
        to = WRONG[wrong](np.random.default_rng(seed), len(patterns))
        with pytest.raises(AcquisitionError, match="must be in the order of their patterns") as found:
            Camera(T, *noise, seed).check(patterns, patterns[to])
        text = str(found.value)
        first = int(np.flatnonzero(to != np.arange(len(to)))[0])
        shows = f"photograph {first} shows "
        assert text.startswith((f"{shows}the pattern of photograph {to[first]}", f"{shows}little of the"))
        assert "\n" not in text
        more = np.count_nonzero(to != np.arange(len(to))) - 3
        assert (f"so do {more} more of this batch" in text) == (more > 0)


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("wrong", ["another's", "one of another batch", "black"])
def test_one_that_is_missing_is_refused(strategy: str, wrong: str) -> None:
    T, grid = scene("corner")
    patterns, others, *_ = batches(strategy, grid)
    for seed in range(12):
        lit, rng = patterns.copy(), np.random.default_rng(seed)
        a, b = rng.choice(len(lit) - 1, 2, replace=False)
        lit[a] = {"another's": lit[b], "one of another batch": others[b], "black": 0.0}[wrong]
        shows = "the pattern of" if wrong == "another's" and strategy == "hadamard" else "little of the"
        with pytest.raises(
            AcquisitionError, match=f"^photograph {a} shows {shows}[^;]*; photographs must be"
        ):
            Camera(T, *NOISES[1], seed).check(patterns, lit)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_batch_in_the_place_of_another_is_refused(strategy: str) -> None:
    T, grid = scene("corner")
    patterns, others, *_ = batches(strategy, grid)
    with pytest.raises(
        AcquisitionError, match=r"shows little of the pattern asked for; .* more of this batch"
    ):
        Camera(T, *NOISES[1], 0).check(patterns, others)


@pytest.mark.parametrize("name", ["narrow corner", "box"])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_deep_scenes(name: str, strategy: str) -> None:
    T, grid = scene(name)
    patterns = next(batches(strategy, grid))
    for seed in range(4):
        for wrong in ("reversed", "one late", "in any order"):
            to = WRONG[wrong](np.random.default_rng(seed), len(patterns))
            with pytest.raises(AcquisitionError, match="must be in the order of their patterns"):
                Camera(T, *NOISES[1], seed).check(patterns, patterns[to])


def plain(n: int, seed: int) -> np.ndarray:
    return 0.6 * np.eye(n) + 0.2 * np.random.default_rng(seed).random((n, n)) / n


def mirrors(n: int, seed: int) -> np.ndarray:
    """A fifth of the pixels light another instead of themselves, and show that."""
    T, rng = plain(n, seed), np.random.default_rng(seed)
    chosen = rng.permutation(n)[: 2 * (n // 5)].reshape(2, -1)
    T[chosen[0], chosen[0]] = 0.0
    T[chosen[1], chosen[0]] += 0.6
    T[chosen[0], chosen[1]] += 0.6
    return T


def pairs(n: int, seed: int) -> np.ndarray:
    """T_ij = T_ji = 2 T_ii for half of the pixels."""
    T, rng = plain(n, seed), np.random.default_rng(seed)
    i, j = rng.permutation(n)[: 2 * (n // 4)].reshape(2, -1)
    T[i, j] = T[j, i] = 1.2
    return T


def unlit(n: int, seed: int) -> np.ndarray:
    """A third of the projector is dark, in one piece."""
    T = plain(n, seed)
    T[:, : n // 3] = 0.0
    return T


def facing(n: int, seed: int) -> np.ndarray:
    """The first quarter shows mostly what the second half sends, and hardly itself."""
    T, some = plain(n, seed), np.arange(n // 4)
    T[some, some] = 0.05
    T[: n // 4, n // 2 :] += 1.2 / n
    return T


def uniform(n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((n, n)) / n


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("made", [mirrors, pairs, unlit, facing, uniform])
def test_scenes_that_are_not_diffuse(made: Callable[..., np.ndarray], strategy: str) -> None:
    for seed in range(8):
        for grid in ((8, 8), (8, 16)):
            T = made(grid[0] * grid[1], seed)[None]
            for noise in NOISES[:3]:
                camera = Camera(T, *noise, seed)
                for patterns in batches(strategy, grid):
                    camera.check(patterns, patterns)


def test_what_may_be_a_mirror_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    """Two of four pixels that show each other twice as well as themselves."""
    T = 0.5 * np.eye(4)
    T[0, 1] = T[1, 0] = 1.0
    with caplog.at_level(logging.WARNING):
        Camera(T[None], 1e-3, 1e5, 0).check(np.eye(4), np.eye(4))
    (record,) = caplog.records
    assert record.getMessage().startswith(
        "photograph 0 shows the pattern of photograph 1; photograph 1 shows"
    )


def test_pixels_that_are_not_known_say_nothing() -> None:
    """Not even where all that is wrong would be seen."""
    T, grid = scene("corner")
    patterns = next(batches("pixel", grid))
    camera = Camera(T, *NOISES[1], 0)
    y = np.einsum("cmn,kn->kcm", T, patterns)
    to = np.arange(len(patterns))
    to[[3, 7]] = 7, 3
    v = np.full(y.shape, 1e-6)
    v[:, :, [3, 7]] = UNKNOWN
    order.check(patterns, np.where(v < 1, y[to], 0.0), v, camera.ambient, camera.white, str)
    v[...] = 1e-6
    with pytest.raises(AcquisitionError, match="3 shows the pattern of 7; 7 shows the pattern of 3; "):
        order.check(patterns, y[to], v, camera.ambient, camera.white, str)
