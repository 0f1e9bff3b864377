# SPDX-License-Identifier: BSD-3-Clause
"""Scenes: walls, albedos, eq. 4, boxes, corners, views, light; T on a wrong grid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl import checks, scenes
from ltcl.device import Device
from ltcl.errors import MemoryLimitError
from ltcl.scenes import Block, Scene, box, cut, dihedral, landscape, trihedral
from ltcl.scenes.builders import WALLS
from ltcl.scenes.scene import transport_matrix
from ltcl.scenes.walls import spread_albedo
from ltcl.transport.diagnostics import other_grid
from tests.scenes.closed_forms import sampled

random = np.random.default_rng(0)
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
    area = rng.uniform(0.5, 2.0, size)
    shared = rng.random((size, size))
    F = (np.triu(shared, 1) + np.triu(shared, 1).T) / area[:, None]
    F *= 0.95 / max(F.sum(axis=1).max(), 1e-300)
    albedo = rng.uniform(0, 0.99, size)
    albedo[:: max(1, size // 3)] = 0
    before = F.copy()
    T = transport_matrix(F, albedo, area)
    np.testing.assert_allclose(T - albedo[:, None] * (F @ T), np.diag(albedo), rtol=0, atol=1e-13)
    np.testing.assert_allclose(area[:, None] * T, (area[:, None] * T).T, rtol=0, atol=1e-13)
    assert not T[albedo == 0].any()
    assert not T[:, albedo == 0].any()
    assert (before == F).all()


def test_view_shows_each_wall_where_it_stands(corner: Scene) -> None:
    """Left wall left, right wall right, floor below, the seam of the two in the middle column."""
    image = corner.view(corner.picture(corner.first_bounce), size=101)
    assert (max(image.shape), image.dtype) == (101, np.float32)
    y, x = (np.array([(0.3, 0.3, 0.75), (0.3, 0.7, 0.5)]).T * image.shape[:2]).astype(int).T
    np.testing.assert_allclose(image[y, x], COLOURS, atol=1e-5)
    assert not image[0, 0].any()


def test_a_lamp_follows_cosine_inverse_square_and_the_shadow_of_a_block() -> None:
    """A thin plate at half the lamp's height: its shadow is straight and twice as large."""
    plate = Block(corner=(0.4, 0.4, 0.5), size=(0.2, 0.2, 1e-6))
    lamp = (0.5, 0.5, 1.0)
    n = 20
    room = box(20, sides=3)
    shaded = replace(room, blocks=(plate,))
    floor, dim = (scene.irradiance(lamp)[:, 2 * n :] for scene in (room, shaded))
    x = np.abs((np.arange(n) + 0.5) / n - 0.5)
    expected = (x[:, None] ** 2 + x**2 + 1) ** -1.5
    np.testing.assert_allclose(floor / floor.max(), expected / expected.max(), rtol=2e-3)
    dark = (x[:, None] < 0.2) & (x < 0.2)
    assert not dim[dark].any()
    np.testing.assert_allclose(dim[~dark], floor[~dark], rtol=1e-5)


def test_patches_lie_in_the_order_of_the_picture() -> None:
    n = 3
    patches = cut(WALLS, 3)
    assert patches.area.sum() == pytest.approx(6)
    for r, w, c in [(0, 0, 0), (2, 1, 0), (1, 5, 2)]:
        wall = WALLS[w]
        number = r * len(WALLS) * n + w * n + c
        right, down = np.array([wall.right, wall.down]) / n
        np.testing.assert_allclose(
            patches.centre[number], wall.corner + (c + 0.5) * right + (r + 0.5) * down
        )
        np.testing.assert_allclose(patches.normal[number], wall.normal)
        np.testing.assert_allclose(
            patches.frames[number] @ patches.frames[number].T, np.eye(3), atol=1e-15
        )


def test_faces_of_a_block_look_outwards_and_close_it() -> None:
    block = Block(corner=(0.2, 0.3, 0.1), size=(0.4, 0.3, 0.5))
    middle = (block.low + block.high) / 2
    flux = 0.0
    for face in block.faces():
        outwards = face.outline.mean(axis=0) - middle
        np.testing.assert_allclose(np.cross(outwards, face.normal), 0, atol=1e-15)
        assert outwards @ face.normal > 0
        assert (np.abs(face.outline - middle) <= np.array(block.size) / 2 + 1e-12).all()
        flux += face.area * (outwards + middle) @ face.normal / 3
    assert flux == pytest.approx(0.4 * 0.3 * 0.5)  # the volume, by Gauss' theorem


@pytest.mark.parametrize(
    ("albedo", "expected"),  # of the first patch of each of two walls, (channels, walls)
    [
        (0.5, [[0.5, 0.5]]),
        ([0.5, 0.25], [[0.5, 0.25]]),
        ([0.1, 0.2, 0.3], [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]),
        ([[0.1, 0.2, 0.3]], [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]),
        ([[0.5], [0.25]], [[0.5, 0.25]]),
        (np.reshape(range(6), (2, 3)) / 10, np.reshape(range(6), (2, 3)).T / 10),
    ],
)
def test_albedo_is_spread_over_walls_and_colours(albedo: Any, expected: Any) -> None:
    # (channels, row, wall, column).
    pictures = spread_albedo(albedo, walls=2, n=3).reshape(-1, 3, 2, 3)
    assert (
        pictures.tolist()
        == np.broadcast_to(np.array(expected)[:, None, :, None], pictures.shape).tolist()
    )


def test_picture_has_saturated_blue_and_orange_white_and_black() -> None:
    picture = landscape(120, 192)
    r = picture[..., 0]
    b = picture[..., 2]
    vivid = (b > 2 * r) & (b > 0.15), (r > 2 * b) & (r > 0.3)
    for there in (*vivid, picture.min(-1) > 0.5, picture.max(-1) < 0.02):
        assert there.mean() > 0.01


@pytest.mark.parametrize("shape", [(1, 1), (1, 300), (200, 1), (640, 640), (320, 1024)])
def test_other_shapes_are_cut_around_the_sun(shape: tuple[int, int]) -> None:
    picture = landscape(*shape)
    whole = landscape(640, 1024)
    assert (picture.shape, picture.dtype) == ((*shape, 3), np.float32)
    assert 0 <= picture.min() <= picture.max() <= 1
    if shape == (640, 640):  # 0.64 of the rest is to the left
        np.testing.assert_array_equal(picture, whole[:, 246 : 246 + 640])


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
    assert max(abs(np.linalg.eigvalsh((R + R.T) / 2))) == pytest.approx(
        albedo / (1 - albedo), rel=1e-9
    )
    # Uniform light glows uniformly.
    assert T.sum(axis=1) == pytest.approx(albedo / (1 - albedo), rel=1e-9)


def test_bounces_of_a_dihedral_alternate() -> None:
    n = 6
    scene = dihedral(6, albedo=0.9)
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
    rooms = [make(3, angle=angle) for angle in angles]
    sums = [room.form_factors.sum(axis=1).mean() for room in rooms]
    assert (np.diff(sums) < 0).all()
    assert sums[-1] < 0.01
    for angle, scene in zip(angles, rooms, strict=True):
        assert all(scene.viewer.sees(wall) for wall in scene.walls)
        turn = scene.walls[0].right @ np.array(scene.walls[1].right)
        assert -turn == pytest.approx(np.cos(np.radians(angle)), abs=1e-12)


def test_too_large_scenes_are_refused_before_anything_is_allocated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(MemoryLimitError, match=r"dihedral.* needs .* TiB"):
        dihedral(10**5)
    monkeypatch.setattr(checks, "host_memory", lambda: 4 * 8 * 96**2 - 1)
    with pytest.raises(MemoryLimitError, match="96 x 96"):
        box(4)
    assert box(4, sides=5).grid == (4, 20)


def test_a_closed_room_with_a_block_loses_no_light_and_is_reciprocal(device: Device) -> None:
    scene = box(7, occluder=LAMP, device=device)
    rows = scene.form_factors.sum(axis=1).reshape(7, 12, 7).swapaxes(0, 1)  # by wall
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
        expected = pytest.approx(mean, abs=5 * error + 5e-3 * mean)
        assert F[:, i, :, :, j].sum() * walls[i].area / N**2 == expected


SCENES = [
    scenes.box(12, sides=3, albedo=0.7),
    scenes.box(8),
    scenes.dihedral(15),
    scenes.trihedral(12),
]


@pytest.mark.parametrize("scene", SCENES, ids=["corner", "closed", "dihedral", "trihedral"])
def test_a_wrong_grid_is_found(scene, tmp_path, caplog):
    """Wrong grids are half and double width, swapped sides, one row; noise fits the right one."""
    transport = scene.transport()
    h, w = transport.grid
    T = transport.to_numpy()
    for width in {w // 2, 2 * w, h, h * w} - {w}:
        if h * w % width == 0:
            assert other_grid(T, (h * w // width, width)) == (h, w), width
    texture = random.uniform(0.1, 1.0, (h * w, 1))
    noise = random.normal(size=T.shape)
    for right in (T, scipy.sparse.csr_array(T), texture * T, T + 0.1 * T.mean() * noise):
        assert other_grid(right, (h, w)) is None
    np.save(tmp_path / "T.npy", T)
    ltcl.Transport(T, (h, w))
    ltcl.load(tmp_path / "T.npy", grid=(h, w))
    assert caplog.messages == []
    ltcl.Transport(scipy.sparse.csr_array(T), (w, h))
    ltcl.load(tmp_path / "T.npy", grid=(w, h))
    assert [str((h, w)) in message for message in caplog.messages] == [True, True]


@pytest.mark.rare
def test_to_numpy_is_T(tmp_path):
    scene = scenes.dihedral(4).transport()
    T = scene.to_numpy()
    grid = scene.grid
    three = [T, 0.5 * T, 0.2 * T]
    ltcl.save(tmp_path / "T.zarr", ltcl.Transport(T, grid))
    for built, dense in (
        (ltcl.Transport(T, grid), T),
        (ltcl.Transport(scipy.sparse.csr_array(T), grid), T),
        (ltcl.Transport(aslinearoperator(T), grid, np.diag(T)), T),
        (ltcl.Transport(three, grid), three),
        (ltcl.Transport([three] * 3, grid), [three] * 3),
        (ltcl.Transport(T[:16], grid, camera_grid=(4, 4)), T[:16]),
        (ltcl.compress(ltcl.Transport(T, grid), rtol=1e-5), T),
        (ltcl.load(tmp_path / "T.zarr"), T),
    ):
        np.testing.assert_allclose(built.to_numpy(), dense, rtol=1e-4, atol=1e-5)
