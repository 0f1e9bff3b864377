# SPDX-License-Identifier: BSD-3-Clause
"""Boxes, dihedrals, trihedrals: what theory says about them, and rooms with a block against sampling."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes import Block, Scene, box, dihedral, trihedral
from tests.scenes.closed_forms import perpendicular, sampled

N = 4
TABLE = Block(corner=(0.3, 0.35, 0), size=(0.35, 0.3, 0.5), albedo=0.6)
LAMP = Block(corner=(0.31, 0.27, 0.2), size=(0.33, 0.41, 0.37), albedo=(0.9, 0.5, 0.2))


def spectrum(scene: Scene) -> np.ndarray:
    """Eigenvalues of A, ascending; A is symmetric where areas and albedos are equal."""
    A = scene.A
    assert isinstance(A, np.ndarray)
    assert (A == A.T).all()
    return np.linalg.eigvalsh(A)


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_closed_box_of_uniform_albedo_reaches_the_bound_of_equation_14(albedo: float) -> None:
    scene = box(N, albedo=albedo)
    assert max(abs(spectrum(scene))) == pytest.approx(albedo, rel=1e-9)
    (T,) = scene.matrices()
    R = T / albedo - np.eye(len(T))
    assert max(abs(np.linalg.eigvalsh((R + R.T) / 2))) == pytest.approx(albedo / (1 - albedo), rel=1e-9)
    assert T.sum(axis=1) == pytest.approx(albedo / (1 - albedo), rel=1e-9)  # uniform light glows uniformly


def test_every_wall_taken_away_weakens_the_bounces() -> None:
    """Figure 5d: fewer sides converge faster; one wall alone shows direct light only."""
    scenes = [box(N, sides=sides, albedo=0.62) for sides in range(1, 7)]
    strength = [max(abs(spectrum(scene))) for scene in scenes]
    assert strength[0] == 0
    assert (np.diff(strength) > 0).all()
    np.testing.assert_allclose(scenes[0].matrices()[0], 0.62 * np.eye(N**2), atol=1e-15)
    names = ["left", "right", "floor", "ceiling", "near right", "near left"]
    for sides, scene in enumerate(scenes, 1):
        assert (scene.grid, [wall.name for wall in scene.walls]) == ((N, N * sides), names[:sides])
        assert scene.area.sum() == pytest.approx(sides)


def test_bounces_of_a_dihedral_alternate_and_its_walls_mirror_each_other() -> None:
    n, scene = 6, dihedral(6, albedo=0.9)
    table, F = perpendicular(n), scene.form_factors.reshape(n, 2 * n, n, 2 * n)
    for row, column, other_row, other_column in [(0, 5, 0, 6), (0, 0, 5, 11), (3, 4, 1, 8)]:
        expected = table[abs(row - other_row), n - 1 - column, other_column - n]
        assert F[row, column, other_row, other_column] == pytest.approx(expected, rel=1e-8)
    assert pytest.approx(F[:, ::-1, :, ::-1], rel=1e-9, abs=1e-15) == F
    assert pytest.approx(F[::-1, :, ::-1, :], rel=1e-9, abs=1e-15) == F
    light = np.zeros((n, 2 * n))
    light[2, 1] = 1
    for bounce in range(1, 5):
        light = (scene.A @ light.ravel()).reshape(n, 2 * n)
        assert not (light[:, :n] if bounce % 2 else light[:, n:]).any()
    eigenvalues = spectrum(scene)
    assert eigenvalues == pytest.approx(-eigenvalues[::-1], abs=1e-12)


@pytest.mark.parametrize(
    ("make", "angles"), [(dihedral, (1, 30, 60, 90, 135, 179)), (trihedral, (5, 30, 60, 90, 119.9))]
)
def test_the_narrower_the_more_light_stays(make: Any, angles: tuple[float, ...]) -> None:
    scenes = [make(3, angle=angle) for angle in angles]
    sums = [scene.form_factors.sum(axis=1).mean() for scene in scenes]
    assert (np.diff(sums) < 0).all()
    assert sums[-1] < 0.01
    for angle, scene in zip(angles, scenes, strict=True):
        assert all(scene.viewer.sees(wall) for wall in scene.walls)
        image = scene.view(np.ones(scene.grid), size=120)
        assert image.max() == pytest.approx(1)
        walls = len(scene.walls)
        F = scene.form_factors.reshape(3, walls, 3, 3, walls, 3).sum(axis=(0, 2, 3, 5))
        np.testing.assert_allclose(F[~np.eye(walls, dtype=bool)], F[0, 1], rtol=1e-7)  # walls are alike
        turn = scene.walls[0].right @ np.array(scene.walls[1].right)
        assert -turn == pytest.approx(np.cos(np.radians(angle)), abs=1e-12)


def test_right_angles_are_those_of_the_cube_whatever_the_way_there() -> None:
    scene, corner = trihedral(N), box(N, sides=3)
    np.testing.assert_allclose(scene.form_factors, corner.form_factors, rtol=1e-9, atol=1e-18)
    for wall, expected in zip(scene.walls, corner.walls, strict=True):
        assert wall.name == expected.name
        np.testing.assert_allclose(wall.outline, expected.outline, atol=1e-15)
    around = [dihedral(N, angle=90 + step).form_factors for step in (-1e-4, 1e-4)]
    np.testing.assert_allclose(sum(around) / 2, dihedral(N).form_factors, rtol=1e-7)


@pytest.mark.parametrize(
    ("make", "arguments", "part"),
    [
        *((make, {"n": bad}, f"n is {bad}") for make in (box, dihedral, trihedral) for bad in (0, 2.0)),
        *((make, {"albedo": 1.0}, r"outside \[0, 1\)") for make in (box, dihedral, trihedral)),
        *((dihedral, {"angle": bad}, "angle is .* above 0 and below 180") for bad in (0, 180, "90", np.nan)),
        *((trihedral, {"angle": bad}, "angle is .* above 0 and below 120") for bad in (0, 120, None, [60])),
        (box, {"sides": 0}, "sides is 0"),
        (box, {"sides": 7}, "sides is 7; it must be at most 6"),
        (box, {"sides": 3, "albedo": [0.1, 0.2, 0.3]}, "one per wall, or one colour"),
        (dihedral, {"albedo": [0.1] * 4}, "albedo has shape"),
        (box, {"occluder": Block((0.8, 0, 0), (0.3, 0.1, 0.1))}, "occluder reaches from .* out of the room"),
        (box, {"occluder": Block((0, 0, 0), (1, 1, 1))}, "occluder fills the room"),
        (box, {"occluder": (0.1, 0.1, 0.1)}, "occluder is .*; it must be an ltcl.scenes.Block"),
    ],
)
def test_bad_scenes_are_refused(make: Any, arguments: dict[str, Any], part: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=part):
        make(**{"n": 2, **arguments})


def test_too_large_scenes_are_refused_before_anything_is_allocated(monkeypatch: pytest.MonkeyPatch) -> None:
    for make, name in ((box, r"box with 6 side\(s\), "), (dihedral, "dihedral"), (trihedral, "trihedral")):
        with pytest.raises(MemoryLimitError, match=f"{name}.* needs .* TiB"):
            make(10**5)
    monkeypatch.setattr(checks, "host_memory", lambda: 4 * 8 * 96**2 - 1)
    with pytest.raises(MemoryLimitError, match="96 x 96"):
        box(4)
    assert box(4, sides=5).grid == (4, 20)


def sums(scene: Scene) -> np.ndarray:
    """Row sums of the form factors by wall, (walls, n, n)."""
    n = scene.grid[0]
    return scene.form_factors.sum(axis=1).reshape(n, -1, n).swapaxes(0, 1)


@pytest.mark.parametrize("n", [4, 7])
def test_a_closed_room_with_a_block_loses_no_light_and_is_reciprocal(device: Device, n: int) -> None:
    scene = box(n, occluder=LAMP, device=device)
    rows = sums(scene)
    assert len(rows) == 12
    assert rows.max() <= 1 + 1e-12
    assert rows[:6].min() > 0.99
    assert np.abs(rows[:6] - 1).mean() < 3e-3
    assert rows[6:].min() > 0.999  # its faces: exact before rows of the room were scaled
    exchange = scene.area[:, None] * scene.form_factors
    np.testing.assert_allclose(exchange, exchange.T, rtol=1e-13)


@pytest.mark.parametrize("block", [TABLE, LAMP])
def test_exchange_past_a_block_agrees_with_sampling(device: Device, block: Block) -> None:
    scene = box(N, occluder=block, device=device)
    walls = scene.walls
    F = scene.form_factors.reshape(N, len(walls), N, N, len(walls), N)
    for i, j in ((0, 4), (1, 5), (2, 3), (0, 5), (2, 4), (1, 6), (3, 10), (2, 6)):
        mean, error = sampled(walls[i], walls[j], 100_000, block)
        assert F[:, i, :, :, j].sum() * walls[i].area / N**2 == pytest.approx(
            mean, abs=5 * error + 5e-3 * mean
        )


def test_the_floor_under_a_block_is_dark_and_a_partition_makes_two_rooms(device: Device) -> None:
    rows = sums(box(10, occluder=TABLE, device=device))
    assert rows[2].mean() == pytest.approx(1 - 0.35 * 0.3, abs=2e-3)  # what of the floor is not covered
    assert not rows[2, 4:6, 4:6].any()
    scene = box(N, occluder=Block((0.25, 0, 0), (0.25, 1, 1), albedo=0.5), device=device)
    assert [wall.name for wall in scene.walls[6:]] == ["block +x", "block -x"]
    F = scene.form_factors.reshape(N, 8, N, N, 8, N)
    assert not F[:, 1, :, :, 5].any()
    assert not F[:, 5, :, :, 7].any()
    assert F[:, 5, :, :, 6].min() > 0
    assert sums(scene)[[1, 5, 6, 7]] == pytest.approx(1, abs=0.01)


def test_colours_of_room_and_block_go_together(device: Device) -> None:
    scene = box(2, sides=2, albedo=0.5, occluder=LAMP, device=device)
    picture = scene.picture(scene.first_bounce)
    assert picture.shape == (2, 16, 3)
    assert picture[[1, 0], [3, 4]].tolist() == [[0.5, 0.5, 0.5], [0.9, 0.5, 0.2]]
    scene = box(2, sides=2, albedo=[(0.1, 0.2, 0.3), (0.4, 0.5, 0.6)], occluder=TABLE, device=device)
    picture = scene.picture(scene.first_bounce)
    assert picture[1, [0, 2, -1]].tolist() == [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.6, 0.6, 0.6]]
    assert scene.area[[0, 4]] == pytest.approx([0.25, 0.3 * 0.5 / 4])  # and its face +x


def test_no_block_no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LTCL_DEVICE", "none such")
    assert box(2).grid == (2, 12)
