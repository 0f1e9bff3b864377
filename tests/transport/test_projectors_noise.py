# SPDX-License-Identifier: BSD-3-Clause
"""Noise of several projectors: carried from each T_k, against errors that are drawn at random."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.transport.noise import Noise
from tests.transport import projectors
from tests.transport.projectors import CAMERA, LEFT, RIGHT

y, x = np.mgrid[: CAMERA[0], : CAMERA[1]]
DESIRED = 0.25 + 0.1 * np.sin(0.6 * x) * np.cos(0.5 * y)
FLOORS = (2e-4, 8e-4)
PHOTONS = (1e-5, 4e-6)
DRAWS = 24


def noise_of(matrix: np.ndarray, number: int) -> Noise:
    """Another noise for each projector, that varies from row to row."""
    noise = Noise.uniform(matrix.shape, FLOORS[number], PHOTONS[number], "acquired")
    rows = np.linspace(0.5, 1.5, matrix.shape[0])[None] if number else noise.rows
    return Noise(
        photons=noise.photons,
        floor=noise.floor,
        rows=rows,
        columns=noise.columns,
        white=noise.white,
        source="acquired",
    )


def members(device: Any, matrices: Any, mixings: Any = (None, None)) -> list[ltcl.Transport]:
    made = []
    for number, (projector, matrix) in enumerate(zip((LEFT, RIGHT), matrices, strict=True)):
        channels = 1 if mixings[number] is None else 3
        noise = noise_of(matrix, number)
        if channels == 3:
            noise = Noise.from_arrays(
                {
                    name: np.repeat(value, 3, axis=0) if np.ndim(value) else value
                    for name, value in noise.to_arrays().items()
                }
            )
        made.append(
            ltcl.Transport(
                matrix if channels == 1 else [matrix] * 3,
                projector.grid,
                camera_grid=CAMERA,
                mixing=mixings[number],
                device=device,
                noise=noise,
            )
        )
    return made


@pytest.fixture(scope="module")
def clean():
    S = projectors.corner()
    return [(S @ p.direct()).astype(np.float32) for p in (LEFT, RIGHT)]


@pytest.fixture(scope="module")
def T(device, clean):
    return ltcl.combine(members(device, clean))


def drawn(clean: Any, random: np.random.Generator) -> list[np.ndarray]:
    """The matrices with errors of their noise."""
    noisy = []
    for number, matrix in enumerate(clean):
        deviation = np.sqrt(noise_of(matrix, number).variance(matrix))
        noisy.append((matrix + deviation * random.standard_normal(matrix.shape)).astype(np.float32))
    return noisy


def test_entries_have_the_variance_of_their_scan(T, clean):
    """The noise of all is measured as that of each, and as large, in the mean of each projector."""
    noise = T.measured_noise
    assert noise is not None
    assert noise.source == "acquired"
    variance = noise.variance(T.to_numpy())
    for number, (matrix, places) in enumerate(zip(clean, T.montage.places, strict=True)):
        expected = noise_of(matrix, number).variance(matrix)
        assert variance[:, places].mean() == pytest.approx(expected.mean(), rel=0.02)
    assert ltcl.analyze(T).verdict.compensation is not None


def test_pictures_have_the_errors_of_all_scans(T, clean):
    c = ltcl.compensate(T, DESIRED, rtol=1e-3)
    random = np.random.default_rng(0)
    squares = np.zeros(CAMERA)
    for _ in range(DRAWS):
        noisy = drawn(clean, random)
        picture = np.zeros(CAMERA[0] * CAMERA[1])
        for matrix, exact, pattern in zip(noisy, clean, c.patterns, strict=True):
            picture += (matrix - exact) @ pattern.ravel()
        squares += picture.reshape(CAMERA) ** 2
    measured = np.sqrt(squares.mean() / DRAWS)
    stated = np.sqrt(np.mean(np.square(c.std.appearance)))
    assert measured == pytest.approx(stated, rel=0.05)
    # The rows of the right one are noisier below.
    ratio = np.sqrt(squares[-4:].mean() / squares[:4].mean())
    std = np.square(c.std.appearance)
    assert np.sqrt(std[-4:].mean() / std[:4].mean()) == pytest.approx(ratio, rel=0.15)
    assert c.std.pattern.shape == T.grid
    assert (c.std.pattern[:, : LEFT.grid[1]][: LEFT.grid[0]] > 0).any()


def test_bounces_have_the_errors_of_all_scans(device, T, clean):
    """The errors of bounces, against those of scans with noise, to 40 %."""
    image = ltcl.compensate(T, DESIRED, rtol=1e-3).appearance
    true = ltcl.separate(T, image, bounces=2, rtol=1e-5)
    random = np.random.default_rng(1)
    squares = np.zeros(2)
    draws = 6
    for _ in range(draws):
        noisy = ltcl.combine(members(device, drawn(clean, random)))
        found = ltcl.separate(noisy, image, bounces=2, rtol=1e-5)
        for k in range(2):
            squares[k] += np.mean((found.bounces[k] - true.bounces[k]) ** 2)
    measured = np.sqrt(squares / draws)
    stated = [np.sqrt(np.mean(np.square(b))) for b in true.std.bounces]
    np.testing.assert_allclose(measured / stated, 1.0, atol=0.4)


def test_mixed_colours_carry_noise(device, clean):
    mixings = (np.eye(3), np.array([[0.9, 0.1, 0.0], [0.1, 0.8, 0.1], [0.0, 0.2, 0.7]]))
    T = ltcl.combine(members(device, clean, mixings))
    desired = np.repeat(0.5 * DESIRED[..., None], 3, axis=-1)
    c = ltcl.compensate(T, desired, rtol=5e-3)
    expected = np.zeros((*CAMERA, 3))
    for number, (matrix, mixing, pattern) in enumerate(
        zip(clean, mixings, c.patterns, strict=True)
    ):
        variance = noise_of(matrix, number).variance(matrix)
        light = pattern.reshape(-1, 3) @ mixing.T
        expected += (variance @ light**2).reshape(*CAMERA, 3)
    np.testing.assert_allclose(c.std.appearance, np.sqrt(expected), rtol=1e-3)


def test_noise_is_that_of_all_or_none(device, clean):
    left, right = members(device, clean)
    unknown = ltcl.Transport(clean[1], RIGHT.grid, camera_grid=CAMERA, device=device)
    assert ltcl.combine([left, unknown]).measured_noise is None
    assert ltcl.combine([left, right]).measured_noise is not None


def test_files_keep_it(T, tmp_path):
    ltcl.save(tmp_path / "both.npz", T)
    again = ltcl.load(tmp_path / "both.npz")
    np.testing.assert_allclose(again.noise.rows, T.noise.rows)
    assert again.measured_noise is not None
