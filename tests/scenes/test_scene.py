# SPDX-License-Identifier: BSD-3-Clause
"""`Scene`: the operators of the paper, exact transport, pictures on the walls, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes import Scene, box, dihedral
from ltcl.scenes.viewer import Viewer

COLOURS = [(0.8, 0.1, 0.1), (0.1, 0.7, 0.2), (0.5, 0.5, 0.5)]


def bounce(scene: Scene) -> np.ndarray:
    """A of a scene without colour."""
    assert isinstance(scene.A, np.ndarray)
    return scene.A


@pytest.fixture(scope="module")
def corner() -> Scene:
    """Three coloured walls, 5 x 5 patches each."""
    return box(5, sides=3, albedo=COLOURS)


def test_bounce_of_one_colour_is_an_array() -> None:
    scene = dihedral(3, albedo=[0.5, 0.25])
    assert (bounce(scene) == np.diag(scene.albedo[0]) @ scene.form_factors).all()
    assert scene.channels == 1
    assert (scene.first_bounce == scene.albedo[0]).all()


def test_bounces_of_three_colours_are_three_arrays(corner: Scene) -> None:
    assert isinstance(corner.A, tuple)
    assert [a.shape for a in corner.A] == [(75, 75)] * 3
    for A, albedo in zip(corner.A, corner.first_bounce, strict=True):
        assert (albedo[:, None] * corner.form_factors == A).all()


def test_matrices_solve_equation_4(corner: Scene) -> None:
    for T, A, albedo in zip(corner.matrices(), corner.A, corner.albedo, strict=True):
        assert pytest.approx(np.diag(albedo), abs=1e-14) == T - A @ T


def test_bounce_is_self_adjoint_in_the_area_over_albedo_inner_product(corner: Scene) -> None:
    for A, albedo in zip(corner.A, corner.albedo, strict=True):
        weighted = (corner.area / albedo)[:, None] * A
        assert weighted == pytest.approx(weighted.T, abs=1e-15)


def test_transport_hands_everything_on(corner: Scene) -> None:
    T = corner.transport(first_bounce=corner.first_bounce)
    assert (T.grid, T.channels, T.shape) == (corner.grid, 3, (75, 75))
    assert T.first_bounce == pytest.approx(corner.albedo)
    assert all((a == b).all() for a, b in zip(T.matrices, corner.matrices(), strict=True))


def test_exact_first_bounce_is_the_albedo() -> None:
    scene = dihedral(4, albedo=[0.9, 0.6])
    assert scene.transport("exact").first_bounce == pytest.approx(scene.first_bounce, rel=1e-12)


def test_transport_relights() -> None:
    scene = dihedral(4, albedo=0.9)
    pattern = np.random.default_rng(2).random(scene.grid).astype(np.float32)
    (T,) = scene.matrices()
    expected = scene.picture(T @ pattern.ravel().astype(np.float64))
    assert scene.transport() @ pattern == pytest.approx(expected, rel=1e-5)


def test_black_patches_are_masked_on_request() -> None:
    scene = dihedral(2, albedo=[0.5, 0.0])
    with pytest.raises(InputError, match="first_bounce"):
        scene.transport()
    assert scene.transport(on_dark="mask").masked.sum() == 4


def test_white_light_on_one_wall_shows_its_albedo_and_a_rising_rest() -> None:
    """Units: a patch under unit light shows its albedo, plus what comes back."""
    scene = dihedral(4, albedo=0.5)
    (T,) = scene.matrices()
    lit = np.zeros(scene.grid)
    lit[:, :4] = 1
    shown = scene.picture(T @ lit.ravel())
    assert (shown[:, :4] > 0.5).all()
    assert (np.diff(shown[:, 4:], axis=1) < 0).all()  # bleeding fades away from the seam


@pytest.mark.parametrize("needed", [("matrices", 3), ("A", 3)])
def test_what_does_not_fit_is_refused(corner: Scene, monkeypatch: pytest.MonkeyPatch, needed: Any) -> None:
    monkeypatch.setattr(checks, "host_memory", lambda: needed[1] * 8 * 75**2 - 1)
    with pytest.raises(MemoryLimitError, match=r"3 matrix.* of 75 x 75"):
        corner.matrices() if needed[0] == "matrices" else corner.A


def test_arrays_are_read_only_and_shared(corner: Scene) -> None:
    own = np.array(corner.form_factors)
    scene = replace(corner, form_factors=own)
    assert np.shares_memory(scene.form_factors, own)
    assert own.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        scene.form_factors[0, 0] = 1


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"grid": (5, 14)}, "walls are 3; they must divide the 14 columns"),
        ({"grid": (5, 0)}, "grid is "),
        ({"grid": (4, 15)}, r"form_factors has shape \(75, 75\); it must be \(60, 60\)"),
        ({"walls": ()}, "walls are 0; a scene needs at least one"),
        ({"albedo": np.zeros((2, 75))}, r"albedo has shape \(2, 75\); it must be \(1, 75\) or \(3, 75\)"),
        ({"albedo": np.ones((1, 75))}, r"albedo has 75 value\(s\) outside \[0, 1\)"),
        ({"albedo": np.full((1, 75), np.nan)}, "albedo has 75 NaN"),
        ({"area": np.ones(74)}, "area has shape"),
        ({"area": np.zeros(75)}, "area has the value 0;"),
        ({"area": np.arange(1.0, 76)}, "breaks reciprocity"),
        ({"form_factors": np.full((75, 75), 0.1)}, "row that sums to 7.5"),
        ({"viewer": Viewer(eye=(-1, -1, -1), target=(0, 0, 0))}, "viewer at .* sees 0 of 3 walls"),
    ],
)
def test_unphysical_scenes_are_refused(corner: Scene, changes: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        replace(corner, **changes)


def test_albedo_must_be_numbers(corner: Scene) -> None:
    with pytest.raises(InputTypeError, match="albedo holds"):
        replace(corner, albedo=np.full((1, 75), "grey"))


def test_picture_is_row_major_with_colours_last(corner: Scene) -> None:
    patches = np.arange(3 * 75).reshape(3, 75)
    picture = corner.picture(patches)
    assert picture.shape == (5, 15, 3)
    assert picture[2, 7].tolist() == [37, 112, 187]
    assert corner.picture(patches[0])[2, 7] == 37
    with pytest.raises(InputError, match=r"patches has shape \(74,\)"):
        corner.picture(np.zeros(74))


def smooth(scene: Scene, n: int) -> np.ndarray:
    """A smooth picture in space, the same on both sides of each seam, (h, w, 3)."""
    v, u = ((np.mgrid[:n, :n] + 0.5) / n)[..., None]
    walls = [np.array(w.corner) + u * np.array(w.right) + v * np.array(w.down) for w in scene.walls]
    return np.sin(2 * np.concatenate(walls, axis=1))


@pytest.mark.parametrize("sides", [1, 2, 3, 4])
def test_sampling_a_view_gives_the_picture_back(sides: int) -> None:
    scene = box(16, sides=sides)
    picture = smooth(scene, 16)
    back = scene.sample(scene.view(picture, size=600))
    assert back.dtype == np.float32
    error = np.abs(back - picture)
    assert np.median(error) < 2e-3
    # Patches on the rim of the view share pixels with the dark beside it.
    assert np.quantile(error, 0.99) < 0.06


def test_walls_behind_the_viewer_take_nothing() -> None:
    scene = box(4, sides=6)
    picture = scene.sample(np.ones((50, 70)))
    assert picture[:, :16] == pytest.approx(1)  # left, right, floor, ceiling
    assert not picture[:, 16:].any()


def test_view_shows_each_wall_where_it_stands(corner: Scene) -> None:
    """Left wall left, right wall right, floor below, the seam of the two in the middle column."""
    image = corner.view(corner.picture(corner.first_bounce), size=101)
    height, width = image.shape[:2]
    for place, colour in {
        (0.3, 0.3): COLOURS[0],
        (0.3, 0.7): COLOURS[1],
        (0.75, 0.5): COLOURS[2],
        (0.0, 0.0): (0, 0, 0),
    }.items():
        assert image[int(place[0] * height), int(place[1] * width)] == pytest.approx(colour, abs=1e-5)


def test_view_sizes_and_types(corner: Scene) -> None:
    image = corner.view(np.ones(corner.grid, int), size=97, supersample=1)
    assert max(image.shape) == 97
    assert image.dtype == np.float32
    assert (corner.view(-np.ones(corner.grid), size=20) <= 0).all()


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"picture": np.ones((5, 14))}, r"picture has shape \(5, 14\); it must be \(5, 15\) or \(5, 15, 3\)"),
        ({"picture": np.full((5, 15), np.inf)}, "picture has 75 NaN or infinite"),
        ({"size": 0}, "size is 0"),
        ({"size": 40000}, "size has 40000 pixels along a side; it must have at most 32766"),
        ({"supersample": 1.5}, "supersample is 1.5"),
    ],
)
def test_bad_views_are_refused(corner: Scene, arguments: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        corner.view(**{"picture": np.ones(corner.grid), **arguments})


@pytest.mark.parametrize(
    ("image", "part"),
    [
        (np.ones(7), r"image has shape \(7,\)"),
        (np.ones((4, 4, 2)), r"image has shape \(4, 4, 2\)"),
        (np.ones((0, 4)), "not empty"),
        (np.full((2, 2), np.nan), "image has 4 NaN"),
        (np.ones((1, 32767)), "image has 32767 pixels along a side"),
    ],
)
def test_bad_images_are_refused(corner: Scene, image: np.ndarray, part: str) -> None:
    with pytest.raises(InputError, match=part):
        corner.sample(image)


def test_images_must_be_numbers(corner: Scene) -> None:
    with pytest.raises(InputTypeError, match="image holds"):
        corner.sample(np.full((2, 2), "x"))
    with pytest.raises(InputTypeError, match="picture holds"):
        corner.view(np.full(corner.grid, 1j))
