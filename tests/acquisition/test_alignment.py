# SPDX-License-Identifier: BSD-3-Clause
"""A T whose camera has other pixels, brought onto the projector's grid."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.cli.main import main
from ltcl.errors import InputError
from ltcl.transport.noise import Noise
from tests import json_schema

GRID = (8, 16)
SCENE = ltcl.scenes.dihedral(8, albedo=0.6)
TRUE = SCENE.transport().to_numpy()


def resampled(rows: int, columns: int) -> np.ndarray:
    """T of a camera of so many pixels, each the mean of what it covers."""
    pictures = TRUE.reshape(*GRID, -1).repeat(10, axis=0).repeat(10, axis=1)
    shrunk = []
    for picture in np.moveaxis(pictures, 2, 0):
        shrunk.append(cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA))
    return np.stack(shrunk, axis=-1).reshape(rows * columns, -1)


def bordered(rows: int, columns: int) -> np.ndarray:
    """The same with three pixels of unlit wall on each side."""
    picture = resampled(rows - 6, columns - 6).reshape(rows - 6, columns - 6, -1)
    return np.pad(picture, ((3, 3), (3, 3), (0, 0))).reshape(rows * columns, -1)


@pytest.mark.parametrize(
    ("camera", "make", "allowed"),
    [
        ((16, 16), resampled, 1e-6),
        ((8, 48), resampled, 1e-6),
        ((24, 48), resampled, 0.01),
        ((20, 40), resampled, 0.01),
        ((14, 27), resampled, 0.07),
        ((22, 38), bordered, 0.01),
    ],
)
def test_T_and_its_bounces_are_those_on_the_grid(device, camera, make, allowed):
    T = ltcl.Transport(make(*camera), GRID, camera_grid=camera, device=device)
    a = ltcl.align(T)
    np.testing.assert_allclose(
        a.transport.to_numpy(), TRUE, atol=allowed * TRUE.max(), rtol=allowed
    )
    assert not a.transport.masked.any()
    photograph = T @ np.ones(GRID)
    b = ltcl.separate(a.transport, a.resampling.apply(photograph), 2)
    square = ltcl.Transport(TRUE, GRID, device=device)
    expected = ltcl.separate(square, square @ np.ones(GRID), 2)
    difference = np.linalg.norm(b.bounces - expected.bounces, axis=(1, 2))
    assert np.all(difference < 5 * allowed * np.linalg.norm(expected.bounces, axis=(1, 2)) + 1e-3)


KINDS: dict[str, Callable[[np.ndarray], Any]] = {
    "sparse": scipy.sparse.csr_array,
    "colour": lambda T: [T, 0.5 * T, 0.2 * T],
    "blocks": lambda T: [[T * (0.1 + (c == d)) for d in range(3)] for c in range(3)],
}


@pytest.mark.parametrize("kind", KINDS)
def test_all_kinds_of_T_are_aligned(device, kind):
    camera = (16, 32)
    T = ltcl.Transport(KINDS[kind](resampled(*camera)), GRID, camera_grid=camera, device=device)
    a = ltcl.align(T, device=device)
    assert (a.transport.camera_grid, a.transport.channels) == (GRID, T.channels)
    pattern = np.random.default_rng(0).random(GRID if T.channels == 1 else (*GRID, 3))
    photograph = a.resampling.apply(T @ pattern)
    np.testing.assert_allclose(a.transport @ pattern, photograph, rtol=1e-4, atol=1e-6)


def test_noise_is_that_of_weighted_rows(device):
    camera = (16, 32)
    noise = Noise.uniform((512, 128), floor=1e-3)
    T = ltcl.Transport(resampled(*camera), GRID, camera_grid=camera, noise=noise, device=device)
    a = ltcl.align(T)
    squares = a.resampling.weights.power(2).sum(axis=1)
    np.testing.assert_allclose(a.transport.noise.rows[0], squares, rtol=1e-5)


@pytest.mark.parametrize(
    ("matrix", "camera", "words"),
    [
        (TRUE, GRID, "camera_grid"),
        (resampled(5, 10), (5, 10), r"\(5, 10\) camera pixels"),
        (scipy.sparse.linalg.aslinearoperator(resampled(16, 16)), (16, 16), "LinearOperator"),
    ],
)
def test_what_cannot_be_aligned_is_refused(device, matrix, camera, words):
    T = ltcl.Transport(matrix, GRID, camera_grid=camera, first_bounce="diagonal", device=device)
    with pytest.raises(InputError, match=words):
        ltcl.align(T)


def test_the_command_aligns_photographs_too(device, capsys, tmp_path):
    camera = (16, 32)
    T = ltcl.Transport(resampled(*camera), GRID, camera_grid=camera, device=device)
    ltcl.save(tmp_path / "T.npz", T)
    photograph = T @ np.full(GRID, 0.5)
    ltcl.images.write(tmp_path / "wall.exr", photograph)
    out = tmp_path / "square.npz"
    assert (
        main(
            [
                "align",
                *map(str, (tmp_path / "T.npz", tmp_path / "wall.exr")),
                "--out",
                str(out),
                "--json",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    json_schema.check(["align"], report)
    assert report["seen"] == 1.0
    folder = tmp_path / "light"
    aligned = report["pictures"][0]
    assert main(["separate", str(out), aligned, "--out", str(folder)]) == 0
    assert "returns to its own pixel" in capsys.readouterr().out
    direct = ltcl.images.read(folder / "direct.exr")
    np.testing.assert_allclose(direct, 0.5 * TRUE.diagonal().reshape(GRID), rtol=0.05)
