# SPDX-License-Identifier: BSD-3-Clause
"""A scene: eq. 4, what it hands on, views and samples, light from a point, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes import Block, Scene, box, dihedral
from ltcl.scenes.scene import transport
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall

COLOURS = [(0.8, 0.1, 0.1), (0.1, 0.7, 0.2), (0.5, 0.5, 0.5)]


@pytest.fixture(scope="module")
def corner() -> Scene:
    """Three coloured walls, 5 x 5 patches each."""
    return box(5, sides=3, albedo=COLOURS)


def test_transport_solves_equation_4_and_hands_everything_on(corner: Scene) -> None:
    assert isinstance(corner.A, tuple)
    for T, A, albedo in zip(corner.matrices(), corner.A, corner.albedo, strict=True):
        assert (albedo[:, None] * corner.form_factors == A).all()
        assert pytest.approx(np.diag(albedo), abs=1e-14) == T - A @ T
    T = corner.transport(first_bounce=corner.first_bounce)
    assert (T.grid, T.channels, T.shape) == (corner.grid, 3, (75, 75))
    assert T.first_bounce == pytest.approx(corner.albedo)
    assert all((a == b).all() for a, b in zip(T.matrices, corner.matrices(), strict=True))
    scene = dihedral(4, albedo=[0.9, 0.6])
    assert scene.transport("exact").first_bounce == pytest.approx(scene.first_bounce, rel=1e-12)
    pattern = np.random.default_rng(2).random(scene.grid).astype(np.float32)
    expected = scene.picture(scene.matrices()[0] @ pattern.ravel().astype(np.float64))
    assert scene.transport() @ pattern == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("size", [1, 2, 7, 512, 513, 1030])  # around the block size
def test_transport_of_unequal_patches(size: int) -> None:
    """Reciprocal form factors with row sums below one, albedos, some 0, and areas."""
    rng = np.random.default_rng(5)
    area, shared = rng.uniform(0.5, 2.0, size), rng.random((size, size))
    F = (np.triu(shared, 1) + np.triu(shared, 1).T) / area[:, None]
    F *= 0.95 / max(F.sum(axis=1).max(), 1e-300)
    albedo = rng.uniform(0, 0.99, size)
    albedo[:: max(1, size // 3)] = 0
    before = F.copy()
    T = transport(F, albedo, area)
    np.testing.assert_allclose(T - albedo[:, None] * (F @ T), np.diag(albedo), rtol=0, atol=1e-13)
    np.testing.assert_allclose(area[:, None] * T, (area[:, None] * T).T, rtol=0, atol=1e-13)
    assert not T[albedo == 0].any()
    assert not T[:, albedo == 0].any()
    assert (before == F).all()


def test_gain_of_one_is_refused() -> None:
    F = np.array([[0.0, 1.0 + 5e-7], [1.0 + 5e-7, 0.0]])  # as far above 1 as a scene lets pass
    with pytest.raises(InputError, match="gain of 1 or more"):
        transport(F, np.full(2, 1 - 1e-9), np.ones(2))


def test_black_patches_are_masked_on_request() -> None:
    scene = dihedral(2, albedo=[0.5, 0.0])
    with pytest.raises(InputError, match="first_bounce"):
        scene.transport()
    assert scene.transport(on_dark="mask").masked.sum() == 4


def test_what_does_not_fit_is_refused(corner: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "host_memory", lambda: 3 * 8 * 75**2 - 1)
    for what in (corner.matrices, lambda: corner.A):
        with pytest.raises(MemoryLimitError, match=r"3 matrix.* of 75 x 75"):
            what()


UNEVEN = np.zeros((75, 75))
UNEVEN[74, 0] = 0.1


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"grid": (5, 14)}, "walls are 3; they must divide the 14 columns"),
        ({"grid": (4, 15)}, r"form_factors has shape \(75, 75\); it must be \(60, 60\)"),
        ({"walls": ()}, "walls are 0; a scene needs at least one"),
        ({"walls": (*box(1, sides=2).walls, Wall("c", (0.5, -1, 0.7), (0, 2, 0), (0, 0, -0.4)))}, "'c' cut"),
        ({"albedo": np.zeros((2, 75))}, r"albedo has shape \(2, 75\); it must be \(1, 75\) or \(3, 75\)"),
        ({"albedo": np.ones((1, 75))}, r"albedo has 75 value\(s\) outside \[0, 1\)"),
        ({"albedo": np.full((1, 75), np.nan)}, "albedo has 75 NaN"),
        ({"area": np.zeros(75)}, "area has the value 0;"),
        ({"area": np.arange(1.0, 76)}, "breaks reciprocity"),
        ({"form_factors": UNEVEN}, "breaks reciprocity by"),
        ({"form_factors": -UNEVEN}, "form_factors has the value -0.1;"),
        ({"form_factors": np.full((75, 75), 0.1)}, "row that sums to 7.5"),
        ({"viewer": Viewer(eye=(-1, -1, -1), target=(0, 0, 0))}, "viewer at .* sees 0 of 3 walls"),
    ],
)
def test_unphysical_scenes_are_refused(corner: Scene, changes: dict[str, Any], part: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=part):
        replace(corner, **changes)


def test_picture_is_row_major_with_colours_last(corner: Scene) -> None:
    patches = np.arange(3 * 75).reshape(3, 75)
    assert corner.picture(patches)[2, 7].tolist() == [37, 112, 187]
    assert corner.picture(patches[0])[2, 7] == 37
    with pytest.raises(InputError, match=r"patches has shape \(74,\)"):
        corner.picture(np.zeros(74))


def test_view_shows_each_wall_where_it_stands(corner: Scene) -> None:
    """Left wall left, right wall right, floor below, the seam of the two in the middle column."""
    image = corner.view(corner.picture(corner.first_bounce), size=101)
    assert (max(image.shape), image.dtype) == (101, np.float32)
    shown = [
        image[int(y * image.shape[0]), int(x * image.shape[1])]
        for y, x in [(0.3, 0.3), (0.3, 0.7), (0.75, 0.5)]
    ]
    np.testing.assert_allclose(shown, COLOURS, atol=1e-5)
    assert not image[0, 0].any()
    assert corner.view(-np.ones(corner.grid), size=20).min() < 0


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"picture": np.ones((5, 14))}, r"picture has shape \(5, 14\); it must be \(5, 15\) or \(5, 15, 3\)"),
        ({"picture": np.full((5, 15), 1j)}, "picture holds"),
        ({"size": 0}, "size is 0"),
        ({"size": 40000}, "size .*40000"),
        ({"image": np.ones(7)}, r"image has shape \(7,\)"),
        ({"image": np.ones((0, 4))}, "not empty"),
        ({"image": np.full((2, 2), np.nan)}, "image has 4 NaN"),
        ({"image": np.ones((1, 32767))}, "image .*32767"),
    ],
)
def test_bad_pictures_are_refused(corner: Scene, arguments: dict[str, Any], part: str) -> None:
    call = corner.sample if "image" in arguments else partial(corner.view, np.ones(corner.grid))
    if "picture" in arguments:
        call = corner.view
    with pytest.raises((InputError, InputTypeError), match=part):
        call(**arguments)


def test_a_lamp_follows_cosine_inverse_square_and_the_shadow_of_a_block() -> None:
    """A thin plate at half the lamp's height: its shadow on the floor is twice as large, and straight."""
    plate = Block(corner=(0.4, 0.4, 0.5), size=(0.2, 0.2, 1e-6))
    lamp, n, room = (0.5, 0.5, 1.0), 20, box(20, sides=3)
    shaded = replace(room, blocks=(plate,))
    floor, dim = (scene.irradiance(lamp)[:, 2 * n :] for scene in (room, shaded))
    x = np.abs((np.arange(n) + 0.5) / n - 0.5)
    expected = (x[:, None] ** 2 + x**2 + 1) ** -1.5
    np.testing.assert_allclose(floor / floor.max(), expected / expected.max(), rtol=2e-3)
    dark = (x[:, None] < 0.2) & (x < 0.2)
    assert not dim[dark].any()
    np.testing.assert_allclose(dim[~dark], floor[~dark], rtol=1e-5)


@pytest.mark.parametrize(
    ("light", "part"),
    [
        ((0.5, 0.5), r"light is \(0.5, 0.5\); it must be three finite numbers"),
        ("above", "light is 'above'; it must be three numbers"),
        ((0.5, -0.5, 0.5), "reaches no patch"),  # behind the left wall, which is opaque
        ((0.45, 0.45, 0.45), "inside a block; move it out"),
    ],
)
def test_bad_lights_are_refused(light: Any, part: str) -> None:
    scene = replace(dihedral(2), blocks=(Block(corner=(0.4, 0.4, 0.4), size=(0.1, 0.1, 0.1)),))
    with pytest.raises((InputError, InputTypeError), match=part):
        scene.irradiance(light)
