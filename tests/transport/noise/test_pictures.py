# SPDX-License-Identifier: BSD-3-Clause
"""Compression for pictures, and down to the noise, against unseen pictures."""

from __future__ import annotations

import pickle
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import scenes
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.landscape import landscape
from tests.transport.noise import measured

random = np.random.default_rng()


@pytest.fixture(autouse=True)
def _seeded(request: pytest.FixtureRequest) -> None:
    global random
    random = np.random.default_rng(list(request.node.name.encode()))


@cache
def compressed(name: str, rtol: Any) -> tuple[ltcl.Transport, ltcl.Transport]:
    """A measured scene, and what `compress` makes of it."""
    T = measured.truth(name)
    T = measured.measure(T, measured.noise_of(T, 3e-4), seed=1)
    return T, ltcl.compress(T, rtol, basis="db2" if rtol == "noise" else "haar")


def text(grid: tuple[int, int]) -> np.ndarray:
    """Letters as OpenCV writes them, white on black."""
    letters = "".join(random.choice(list("ABCDEFGH123"), 12))
    canvas = np.zeros(grid, np.uint8)
    return (
        cv2.putText(canvas, letters, (0, grid[0] - 3), cv2.FONT_HERSHEY_PLAIN, 0.7, (255,)) / 255.0
    )


def photograph(grid: tuple[int, int]) -> np.ndarray:
    """A part of the landscape, at random."""
    whole = np.asarray(landscape(96, 192), np.float64).mean(axis=2)
    y, x = random.integers(0, (40, 90))
    side = int(random.integers(24, 56))
    return cv2.resize(whole[y : y + side, x : x + side], grid[::-1], interpolation=cv2.INTER_AREA)


def checkerboard(grid: tuple[int, int]) -> np.ndarray:
    side = int(random.integers(1, 5))
    return (np.add.outer(np.arange(grid[0]) // side, np.arange(grid[1]) // side) % 2).astype(float)


def pixel(grid: tuple[int, int]) -> np.ndarray:
    return np.eye(1, grid[0] * grid[1], int(random.integers(grid[0] * grid[1]))).reshape(grid)


@cache
def dense(T: ltcl.Transport) -> tuple[np.ndarray, np.ndarray]:
    """S and its inverse in float64."""
    S = T.systems[0].to_dense().astype(np.float64)
    return S, np.linalg.inv(S)


def losses(T: ltcl.Transport, C: ltcl.Transport, picture: np.ndarray) -> list[float]:
    """Errors of a picture, its direct light, the pattern that shows it, and the picture of that."""
    (S, inverse), (approximate, other) = map(dense, (T, C))
    direct = T.first_bounce * picture.ravel()
    b = picture.ravel()
    pattern = other @ b
    pairs = [
        (approximate @ direct, S @ direct),
        (other @ S @ direct, direct),
        (pattern, inverse @ b),
        (S @ pattern, b),
    ]
    return [float(np.linalg.norm(a - exact) / np.linalg.norm(exact)) for a, exact in pairs]


@pytest.mark.slow
@pytest.mark.parametrize("name", measured.SCENES)
def test_pictures_that_were_not_drawn_lose_no_more_than_is_stated(name: str) -> None:
    T, C = compressed(name, 0.02)
    (report,) = C.compression.channels
    largest = max(
        max(losses(T, C, draw(T.grid))) for draw in (text, photograph, checkerboard, pixel) * 2
    )
    assert largest <= 1.5 * C.error
    assert C.error == report.solution_error == report.pictures.error <= 0.02
    assert report.pictures.share >= 0.95
    assert report.pictures.confidence >= 0.99
    (S, _), (approximate, inverse) = map(dense, (T, C))
    worst = np.linalg.norm(inverse @ (approximate - S), 2)
    assert C.error < worst <= C.error_bound == report.error_bound


@pytest.mark.slow
@pytest.mark.parametrize("name", measured.SCENES)
def test_noise_is_dropped_and_no_more(name: str) -> None:
    T, C = compressed(name, "noise")
    other = measured.measure(
        measured.truth(name), measured.noise_of(measured.truth(name), 3e-4), seed=2
    )
    p = random.random((4, *T.grid))
    error, exact = (np.linalg.norm(A @ p - other @ p) for A in (C, T))
    assert error <= 1.1 * exact
    assert C.nbytes < 0.5 * T.nbytes
    assert C.compression.rtol == "noise"


@pytest.mark.slow
def test_both_errors_are_in_files_pickles_and_requests(tmp_path: Any) -> None:
    T, C = compressed("corner", 0.02)
    ltcl.save(tmp_path / "C.npz", C)
    for again in (ltcl.load(tmp_path / "C.npz"), pickle.loads(pickle.dumps(C))):  # noqa: S301
        assert (again.error, again.error_bound) == (C.error, C.error_bound)
    arrays = dict(np.load(tmp_path / "C.npz"))
    del arrays["system_0.error_bound"]  # as files were
    np.savez(tmp_path / "old.npz", **arrays)
    old = ltcl.load(tmp_path / "old.npz")
    assert old.error == old.error_bound == C.error
    desired = T @ np.full(T.grid, 0.5)
    assert ltcl.compensate(C, desired, rtol=C.error).transport_error == C.error
    assert ltcl.separate(C, desired, rtol=C.error).transport_error == C.error
    refined = ltcl.compensate(C, desired, rtol=1e-4, exact=T)
    assert np.linalg.norm(T @ refined.pattern - desired) <= 1e-3 * np.linalg.norm(desired)
    for refused in (ltcl.compensate, ltcl.separate):
        with pytest.raises(InputError, match="rtol is"):
            refused(C, desired, rtol=0.9 * C.error)
    with pytest.raises(InputError, match="rtol is"):
        ltcl.invert(C, rtol=C.error)
    inverse = ltcl.invert(C, rtol=2 * C.error)
    assert C.error < inverse.error <= 2 * C.error
    assert ltcl.compensate(C, desired, inverse=inverse).rtol == max(1e-2, inverse.error)
    assert C.systems[0].T.solution_error == C.error_bound


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"norm": "frobenius"}, "norm is 'frobenius'"),
        ({"rtol": "nois"}, "rtol is 'nois'"),
        ({"rtol": "noise", "T": np.eye(4), "grid": (2, 2)}, "T is a ndarray; it must be"),
    ],
)
def test_refusals(options: dict[str, Any], words: str) -> None:
    T = options.pop("T", None)
    with pytest.raises((InputError, InputTypeError), match=words):
        ltcl.compress(scenes.dihedral(2).transport() if T is None else T, **options)
