# SPDX-License-Identifier: BSD-3-Clause
"""Rays between patches against a brute-force twin; boxes that block all, nothing, or only graze."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange import geometry
from ltcl.scenes.exchange.geometry import Frame
from ltcl.scenes.exchange.visibility import Rays, visibility
from ltcl.scenes.patches import Patches, cut
from ltcl.scenes.walls import Wall
from tests import reference


def random_scene(count: int, boxes: int, seed: int) -> tuple[Patches, np.ndarray]:
    rng = np.random.default_rng(seed)
    centre, right, down = rng.uniform(-1, 1, (3, count, 3)) * np.array([3, 0.3, 0.3])[:, None, None]
    low = rng.uniform(-3, 2, (boxes, 3))
    return Patches(centre, right, down), np.stack([low, low + rng.uniform(0.2, 2, (boxes, 3))], axis=1)


def box_faces(low: tuple[float, ...], high: tuple[float, ...]) -> list[Wall]:
    """The six faces of a box, seen from outside."""
    (x, y, z), (a, b, c) = low, np.subtract(high, low)
    return [
        Wall("x low", (x, y, z), (0, b, 0), (0, 0, c)),
        Wall("x high", (x + a, y, z), (0, 0, c), (0, b, 0)),
        Wall("y low", (x, y, z), (0, 0, c), (a, 0, 0)),
        Wall("y high", (x, y + b, z), (a, 0, 0), (0, 0, c)),
        Wall("z low", (x, y, z), (a, 0, 0), (0, b, 0)),
        Wall("z high", (x, y, z + c), (0, b, 0), (a, 0, 0)),
    ]


def read_by_kernel(
    device: Device, patches: Patches, blocks: np.ndarray, samples: int
) -> tuple[np.ndarray, ...]:
    """Starts, ends (rays, 3, N), normals (3, N) and boxes (B, 6) in float32, as they lie on the device."""
    rays = Rays(patches, blocks, device, samples)
    starts, ends = (
        points.get().reshape(samples**2, 3, -1)[..., : len(patches)] for points in (rays._starts, rays._ends)
    )
    return starts, ends, rays._normals.get()[:, : len(patches)], rays._blocks.get()


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 53])
@pytest.mark.parametrize(("boxes", "samples"), [(1, 1), (1, 3), (2, 2), (5, 4)])
def test_rows_and_pairs_meet_their_twin(device, count, boxes, samples):
    patches, blocks = random_scene(count, boxes, seed=count)
    found = visibility(patches, blocks, device, samples=samples)
    read = read_by_kernel(device, patches, blocks, samples)
    expected = reference.form_factor_visible(*read)
    # A ray that grazes a box or a plane to rounding counts either way: one in a hundred entries at most.
    assert np.count_nonzero(np.abs(found - expected) > 1e-6) <= 0.01 * count**2
    np.testing.assert_array_equal(found, found.T)
    i, j = np.divmod(np.arange(count**2), count)
    pairs = Rays(patches, blocks, device, samples).pairs(i, j)
    np.testing.assert_array_equal(pairs.reshape(count, count), found)


def test_rows_in_parts_are_those_of_the_whole(device, monkeypatch):
    patches, blocks = random_scene(30, 3, seed=1)
    whole = visibility(patches, blocks, device)
    monkeypatch.setattr("ltcl.scenes.exchange.visibility._LAUNCH", 30 * 16 * 3 * 7)  # 7 rows at a time
    assert Rays(patches, blocks, device, 4).most_rows() == 7
    np.testing.assert_array_equal(visibility(patches, blocks, device), whole)
    i, j = np.triu_indices(30, 1)
    np.testing.assert_array_equal(Rays(patches, blocks, device, 4).pairs(i, j), whole[i, j])


def test_a_screen_blocks_all_and_a_box_elsewhere_nothing(device):
    patches = cut((WALLS[1], WALLS[5]), 3)  # x = 0 and x = 1
    across = np.abs(patches.centre[:, None, 0] - patches.centre[:, 0]) > 0.5
    np.testing.assert_array_equal(visibility(patches, [[(0.4, -1, -1), (0.6, 2, 2)]], device), ~across)
    assert visibility(patches, [[(2, 2, 2), (3, 3, 3)]], device).min() == 1.0


def test_half_a_screen_blocks_what_is_below_it(device):
    ends = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    z, y = np.array([[[0, 0, 1e-3]], [[0, 1e-3, 0]]])
    patches = Patches(ends, np.concatenate([z, y]), np.concatenate([y, z]))  # face to face
    for height, expected in ((-0.1, 1.0), (0.1, 0.0)):
        screen = [[(-0.1, -1, -1), (0.1, 1, height)]]
        assert visibility(patches, screen, device)[0, 1] == expected


@pytest.mark.parametrize(
    "corners", [((0.25, 0.25, 0.0), (0.75, 0.5, 0.5)), ((0.31, 0.23, 0.0), (0.68, 0.52, 0.43))]
)
def test_a_box_does_not_block_its_own_faces(device, corners):
    """A box on the floor of a room: its faces see all that is in front of them, on the grid or off it."""
    low, high = corners
    n = 4
    walls = [*WALLS, *box_faces(low, high)]
    patches = cut(walls, n)
    seen = visibility(patches, [[low, high]], device)
    wall = np.arange(len(patches)) // n % len(walls)
    # Light that leaves a face of a convex box to the front never meets that box.
    assert seen[wall >= 6].min() == 1.0
    # Rays along a wall, past the box, are free; the box hides part of the room.
    assert seen[np.ix_(wall < 6, wall < 6)].min() < 1.0


def test_faces_and_edges_that_only_touch_do_not_block(device):
    """Rays within the plane of a face, and along an edge, pass."""
    ends = np.array([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0], [-1.0, -1.0, 1.0], [1.0, -1.0, 1.0]])
    patches = Patches(ends, np.full((4, 3), [0, 1e-9, 0]), np.full((4, 3), [1e-9, 0, 0]))
    seen = visibility(patches, [[(-0.5, -1.0, 0.0), (0.5, 0.5, 1.0)]], device)
    assert seen.min() == 1.0


def test_no_box_no_device(monkeypatch):
    monkeypatch.setattr("ltcl.scenes.exchange.visibility.open_device", lambda *_: pytest.fail("opened"))
    assert visibility(cut(WALLS, 1), []).min() == 1.0


def test_bad_input_is_refused(device, monkeypatch):
    patches = cut(WALLS, 1)
    cube = [[(0, 0, 0), (1, 1, 1)]]
    for blocks, part in (
        ([[(0, 0, 0), (1, 1, -1)]], "the first must be below"),
        ([[(0, 0, 0)]], r"blocks has shape \(1, 1, 3\)"),
        ([[(0, 0, 0), (1, 1, np.nan)]], "blocks has 1 NaN"),
    ):
        with pytest.raises(InputError, match=part):
            visibility(patches, blocks, device)
    with pytest.raises(InputError, match="samples is 0"):
        visibility(patches, cube, device, samples=0)
    with pytest.raises(InputError, match="samples is 65; it must be at most 64"):
        visibility(patches, cube, device, samples=65)
    with pytest.raises(InputTypeError, match="patches is a list"):
        visibility([1], cube, device)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="patches are 0"):
        visibility(Patches(*np.zeros((3, 0, 3))), cube, device)
    with pytest.raises(InputError, match=r"patches.right has shape \(5, 3\)"):
        visibility(Patches(patches.centre, patches.right[:5], patches.down), cube, device)
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 64)
    with pytest.raises(MemoryLimitError, match="the visibility of 6 x 6 patches needs 144 B"):
        visibility(patches, cube, device)


def test_frame_holds_all_patches():
    patches, blocks = random_scene(20, 3, seed=3)
    moved = Patches(1e5 + 7 * patches.centre, 7 * patches.right, 7 * patches.down)
    frame = Frame.of(moved)
    placed = frame.patches(moved)
    for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        corner = placed.centre + (signs[0] * placed.right + signs[1] * placed.down) / 2
        assert np.abs(corner).max() <= 0.5 + 1e-9
    np.testing.assert_allclose(placed.area * frame.size**2, moved.area)
    box = frame.blocks(blocks)
    np.testing.assert_allclose(box[:, :3] * frame.size + frame.middle, blocks.mean(axis=1))
    assert (box[:, 3:] > 0).all()
    assert geometry.check_blocks(None).shape == (0, 2, 3)
