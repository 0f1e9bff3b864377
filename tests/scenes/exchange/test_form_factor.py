# SPDX-License-Identifier: BSD-3-Clause
"""The operator that stores no form factors: against its twin, the exact matrix, and in solves."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import ltcl
from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import IdentityPlus
from ltcl.scenes import Block, FormFactor, Patches, box, cut, dihedral, visibility
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange import geometry as scene_geometry
from ltcl.scenes.exchange import near
from ltcl.scenes.walls import form_factors
from tests import gallery, reference
from tests.operators import helpers
from tests.scenes.exchange.test_near import leaning, turned
from tests.scenes.exchange.test_visibility import box_faces

BLOCK = [[(0.25, 0.25, 0.0), (0.75, 0.5, 0.5)]]


def kernel_matrix(A: FormFactor) -> tuple[np.ndarray, np.ndarray]:
    """What the kernel and the stored corrections stand for, (N, N) float64 each, by the twin."""
    count = A.shape[0]
    geometry, blocks = A._geometry.get()[:, :count], A._blocks.get()[: A._defines["BLOCKS"]]
    G = reference.form_factor_entries(geometry, blocks)
    albedo, area = A._albedo.get().astype(np.float64), A._area.get().astype(np.float64)
    return albedo[:, None] * G * area, A._near.to_dense()


def tiles(count: int, seed: int) -> Patches:
    """Parallelograms of many sizes around a middle, most of which see each other."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    right = np.cross(out, rng.normal(size=(count, 3)))
    down = np.cross(right, out) + 0.3 * right  # down x right points to the middle
    scale = rng.uniform(0.02, 0.1, (count, 1))
    return Patches(3 * out, scale * right, scale * down)


def astride() -> Patches:
    """A patch on the floor, and one 20 sizes away that stands half below its plane: both see but a part."""
    centre, right, down = [(0, 0, 0), (20, 0, 0.1)], [(1, 0, 0), (0, 1, 0)], [(0, -1, 0), (0, 0, 1)]
    return Patches(*(np.array(edge, np.float64) for edge in (centre, right, down)))


SCENES = {
    "astride a plane": (astride, None),
    "1 patch": (lambda: cut(WALLS[:1], 1), None),
    "2 patches": (lambda: cut(WALLS[:2], 1), None),
    "7 tiles": (lambda: tiles(7, 1), None),
    "53 tiles": (lambda: tiles(53, 2), None),
    "tiles around a block": (lambda: tiles(23, 3), [[(-1, -1, -1), (1, 1, 1)]]),
    "room": (lambda: cut(WALLS, 3), None),
    "room with a block": (lambda: cut([*WALLS, *box_faces(*BLOCK[0])], 2), BLOCK),
    "two blocks": (lambda: cut(WALLS, 3), [*BLOCK, [(0.4, 0.6, 0.2), (0.6, 0.7, 0.9)]]),
}


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("lanes", [1, 8])
def test_products_meet_their_twin(device, monkeypatch, name, lanes):
    monkeypatch.setattr(scene_geometry, "lanes", lambda _: lanes)
    make, blocks = SCENES[name]
    patches = make()
    A = FormFactor(patches, np.linspace(0.2, 0.9, len(patches)), blocks, device)
    kernel, correction = kernel_matrix(A)
    matrix = kernel + correction
    # An entry is some 30 roundings; corrections cancel kernel values, which then count with their size.
    size = np.abs(kernel) + np.abs(correction) + np.abs(matrix)

    # Each number of right-hand sides is a build of its own.
    columns = helpers.COLUMNS if name == "53 tiles" else (None, 5)

    def check(apply, twin, magnitude):
        for k in columns:
            x, add = gallery.vectors(len(patches), k), gallery.vectors(len(patches), k, 2)
            for scale, given in ((1.0, None), (-0.75, add)):
                added = None if given is None else device.upload(given)
                found = apply(device.upload(x), None, scale=scale, add=added).get()
                expected = reference.dense_matvec(twin, x, scale, given)
                helpers.close(found, expected, 32 * reference.product_error(magnitude, x, scale, given))

    if blocks is None:  # else a ray that grazes a block counts either way
        check(A.apply, matrix, size)
        check(A.apply_transpose, matrix.T, size.T)
    else:
        dense = A.to_dense()
        off = np.abs(dense - matrix) > 1e-4 * size
        assert np.count_nonzero(off) <= 0.01 * off.size
        check(A.apply, dense, size)
        check(A.apply_transpose, dense.T, size.T)


@pytest.mark.parametrize("transpose", [False, True])
def test_products_take_the_whole_epilogue(device, transpose):
    """out = a (A x) + b y + c x, y being out, of pieces of 4 and 1 right-hand sides."""
    A = FormFactor(cut(WALLS, 2), np.linspace(0.2, 0.9, 24), None, device)
    x, y = gallery.vectors(24, 5), gallery.vectors(24, 5, 2)
    out = device.upload(y)
    apply, matrix = (A.apply_transpose, A.to_dense().T) if transpose else (A.apply, A.to_dense())
    apply(device.upload(x), out, scale=-0.75, add=out, add_scale=0.5, shift=2.0)
    np.testing.assert_allclose(out.get(), -0.75 * (matrix @ x) + 0.5 * y + 2 * x, rtol=0, atol=1e-5)


@pytest.mark.parametrize("lanes", [1, 8])
@pytest.mark.parametrize("blocks", [None, BLOCK])
def test_kernel_values_of_pairs_are_those_of_the_product(device, monkeypatch, lanes, blocks):
    monkeypatch.setattr(scene_geometry, "lanes", lambda _: lanes)
    patches = cut(WALLS, 2)
    A = FormFactor(patches, None, blocks, device)
    i, j = np.divmod(np.arange(len(patches) ** 2), len(patches))
    pairs = A._kernel_pairs(i, j).reshape(len(patches), -1)
    product = (A.to_dense() - A._near.to_dense()) / A._area.get()
    np.testing.assert_allclose(pairs, product, rtol=1e-5, atol=1e-5 * pairs.max())
    read = A._geometry.get()[:, : len(patches)], A._blocks.get()[: A._defines["BLOCKS"]]
    entries = reference.form_factor_entries(*read)
    twin = reference.form_factor_pairs(entries, i, j).reshape(pairs.shape)
    off = np.abs(pairs - twin) > 1e-4 * twin.max()  # a ray that grazes a block counts either way
    assert np.count_nonzero(off) <= (0 if blocks is None else 0.01 * off.size)


def smooth(patches: Patches) -> np.ndarray:
    """Three smooth pictures, (N, 3)."""
    x, y, z = patches.centre.T
    return np.stack([np.ones_like(x), 1 + np.sin(3 * x + 1) * np.cos(2 * y) + z, z**2], axis=1)


@pytest.mark.parametrize(("sides", "n"), [(6, 1), (6, 3), (6, 8), (3, 8), (2, 3), (2, 20)])
def test_products_are_those_of_the_exact_matrix(device, sides, n):
    """Closed forms: F x within 1e-4 of the largest value for smooth x, and the 2-norm within `error`."""
    patches, F = cut(WALLS[:sides], n), form_factors(WALLS[:sides], n)
    A = FormFactor(patches, device=device)
    x = smooth(patches)
    for product in (A @ x, A.T @ x):
        np.testing.assert_array_less(np.abs(product - F @ x).max(axis=0), 1e-4 * (F @ x).max(axis=0))
    assert np.linalg.norm(A.to_dense() - F, 2) <= A.error == 1e-4
    assert not A.diagonal().any()


@pytest.mark.parametrize("angle", [30, 70, 130])
def test_products_are_those_of_exact_factors_at_any_angle(device, angle):
    """All pairs by the quadrature that is otherwise kept for near ones."""
    patches = cut(turned(angle), 12)
    F = np.zeros((len(patches),) * 2)
    i, j = near.pairs(patches, 1e3)
    F[i, j] = F[j, i] = near.form_factors(patches, i, j)
    A = FormFactor(patches, device=device)
    x = smooth(patches)
    np.testing.assert_array_less(np.abs(A @ x - F @ x).max(axis=0), 1e-4 * (F @ x).max(axis=0))


@pytest.mark.parametrize("angle", [45, 90])
def test_closed_rooms_lose_no_light(device, angle):
    """Also of rhombi, far from the origin, in large units: F has no unit."""
    patches = cut(leaning(angle), 9)
    moved = Patches(1e4 + 1e3 * patches.centre, 1e3 * patches.right, 1e3 * patches.down)
    for each in (patches, moved):
        A = FormFactor(each, device=device)
        np.testing.assert_allclose(A.row_sums(), 1, atol=1e-4)
        share = each.area / each.area.max()
        np.testing.assert_allclose(A.T @ share, share, atol=1e-4)


def test_albedo_scales_rows(device):
    patches = cut(WALLS, 2)
    albedo = np.linspace(0.1, 0.9, len(patches))
    F, A = FormFactor(patches, device=device), FormFactor(patches, albedo, device=device)
    np.testing.assert_allclose(A.to_dense(), albedo[:, None] * F.to_dense(), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(FormFactor(patches, 0.5, device=device).row_sums(), 0.5, atol=1e-4)
    assert A.error == pytest.approx(0.9e-4)


def test_block_hides_what_rays_say(device):
    """Each entry is the free one times the visible share; a block that nobody looks past changes nothing."""
    patches = cut([*WALLS, *box_faces(*BLOCK[0])], 4)
    free, hidden = (FormFactor(patches, None, blocks, device).to_dense() for blocks in (None, BLOCK))
    seen = visibility(patches, BLOCK, device, samples=8)
    np.testing.assert_allclose(hidden[seen == 1], free[seen == 1], atol=1e-6)
    assert np.abs(hidden[seen == 0]).max() < 1e-6
    # The rest is a matter of a few rays; its sum over a row is not.
    np.testing.assert_allclose(hidden.sum(axis=1), (seen * free).sum(axis=1), atol=0.03)
    # A closed room with a solid block loses no light: what leaves a face arrives somewhere.
    inside = np.arange(len(patches)) // 4 % 12 != 10  # but for the face that lies on the floor
    assert np.abs(hidden.sum(axis=1)[inside] - 1).mean() < 0.1


@pytest.mark.parametrize("n", [4, 8])
@pytest.mark.parametrize(
    "block",
    [
        Block((0.31, 0.23, 0), (0.37, 0.29, 0.43), albedo=0.5),  # on the floor, faces cut patches
        Block((0.31, 0.23, 0.17), (0.37, 0.29, 0.43), albedo=0.5),  # in the air, faces cut patches
        Block((0.25, 0.25, 0.25), (0.5, 0.5, 0.25), albedo=0.5),  # faces between patches
        Block((0, 0.4, 0), (0.3, 0.6, 0.7), albedo=0.5),  # in a corner
    ],
)
def test_rooms_with_a_block_are_those_of_the_host(device, n, block):
    """Exact form factors times 256 rays a pair: 1.5 % of the norm, and no light made."""
    room = box(n, albedo=0.5, occluder=block, device=device)
    F = FormFactor(cut(room.walls, n), None, [(block.low, block.high)], device).to_dense()
    assert np.linalg.norm(F - room.form_factors) < 0.015 * np.linalg.norm(room.form_factors)
    sums, expected = F.sum(axis=1), room.form_factors.sum(axis=1)
    np.testing.assert_allclose(sums, expected, atol=0.06)  # of a patch half under the block
    assert sums.max() < 1.02
    # Of a face and the room nothing is in between: only float32 and the kernel's quadrature are left.
    face = np.arange(len(F)) // n % len(room.walls) >= 6
    np.testing.assert_allclose(F[face], room.form_factors[face], atol=2e-3)


def test_callers_own_near_values(device):
    patches, F = cut(WALLS, 3), form_factors(WALLS, 3)
    asked = []

    def exact(i, j):
        asked.append(len(i))
        return F[i, j]

    A = FormFactor(patches, device=device, near=exact)
    assert asked[0] > 0
    np.testing.assert_allclose(A.to_dense(), F, atol=1e-6)
    for bad, part in ((lambda i, j: F[0], r"near\(i, j\) has shape"), (lambda i, j: np.nan * i, "NaN")):
        with pytest.raises(InputError, match=part):
            FormFactor(patches, device=device, near=bad)


def test_launches_in_slabs_give_the_same(device, monkeypatch):
    patches = cut(WALLS, 3)
    A = FormFactor(patches, 0.5, device=device)
    x = device.upload(gallery.vectors(len(patches), 5))
    whole = A.apply(x).get()
    monkeypatch.setattr("ltcl.scenes.exchange.form_factor._LAUNCH", 7 * A._geometry.shape[1])
    before = device.launches.copy()
    cut_up = A.apply(x).get()
    assert (device.launches - before)["form_factor_matvec"] == 2 * 8  # 4 + 1 right-hand sides, 54 rows by 7
    error = reference.product_error(A.to_dense(), x.get())
    helpers.same_rows(device, whole, cut_up, error)


def test_forward_light_without_storing_a_bounce(device):
    """(I - A) l = l_d against the dense solution, in a room of three colours, one after the other."""
    room = box(4, albedo=(0.8, 0.5, 0.3))
    patches = cut(room.walls, 4)
    l_d = np.random.default_rng(1).random(len(patches))
    matrices = room.A
    assert isinstance(matrices, tuple)
    for albedo, dense in zip(room.albedo, matrices, strict=True):
        A = FormFactor(patches, albedo, device=device)
        found = ltcl.solve(IdentityPlus(A, sign=-1), l_d, rtol=1e-5)
        assert found.converged
        expected = np.linalg.solve(np.eye(len(l_d)) - dense, l_d)
        np.testing.assert_allclose(found.x, expected, rtol=1e-3)


def test_a_scene_gives_its_operators(device):
    """One per channel, as good as the scene's own matrix; light through them as through that."""
    room = box(
        6, albedo=(0.8, 0.5, 0.3), occluder=Block((0.31, 0.23, 0), (0.37, 0.29, 0.43), 0.6), device=device
    )
    l_d = np.random.default_rng(2).random(len(room.area))
    operators, matrices = FormFactor.of(room, device), room.A
    for A, dense in zip(operators, matrices, strict=True):
        assert np.linalg.norm(A.to_dense() - dense) < 0.015 * np.linalg.norm(dense)
        found = ltcl.solve(IdentityPlus(A, sign=-1), l_d, rtol=1e-4).x
        expected = np.linalg.solve(np.eye(len(l_d)) - dense, l_d)
        assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)
    (A,) = FormFactor.of(dihedral(5, albedo=0.5), device)  # free of blocks: to the bound
    np.testing.assert_allclose(A.to_dense(), dihedral(5, albedo=0.5).A, atol=A.error)


def test_a_scene_of_oblong_walls_is_refused(device):
    scene = dataclasses.replace(dihedral(2), grid=(1, 8))
    with pytest.raises(InputError, match=r"scene has walls of 1 x 4 patches; they must be n x n"):
        FormFactor.of(scene, device)


@pytest.mark.parametrize("method", ["neumann", "richardson", "chebyshev", "gmres", "bicgstab", "cg"])
def test_solvers_take_it(device, method):
    scene = dihedral(4, albedo=0.6)
    A = FormFactor(cut(scene.walls, 4), scene.first_bounce, device=device)
    l_d = gallery.vectors(32, 2)
    found = ltcl.solve(IdentityPlus(A, sign=-1), l_d, method=method, rtol=1e-4)
    np.testing.assert_allclose(found.x, np.linalg.solve(np.eye(32) - scene.A, l_d), atol=2e-3)


def test_stored_bytes_grow_with_patches_not_pairs(device):
    sizes = [FormFactor(cut(WALLS[:3], n), device=device).nbytes / (3 * n**2) for n in (6, 24)]
    assert sizes[1] < sizes[0]


def test_bad_input_is_refused(device, monkeypatch):
    patches = cut(WALLS, 2)
    for arguments, part in (
        ((patches, 1.0), r"albedo has 1 value\(s\) outside \[0, 1\)"),
        ((patches, [0.5, 0.5]), r"albedo has shape \(2,\); it must be \(\) or \(24,\)"),
        ((patches, None, [[(0, 0, 0), (0, 1, 1)]]), "the first must be below"),
        ((dataclasses.replace(patches, right=patches.down),), "24 without area, the first at 0"),
        ((dataclasses.replace(patches, centre=np.nan * patches.centre),), "patches.centre has 72 NaN"),
    ):
        with pytest.raises(InputError, match=part):
            FormFactor(*arguments, device=device)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputTypeError, match="patches is a ndarray"):
        FormFactor(patches.centre, device=device)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(device, "memory", 1000)
    monkeypatch.setattr(Device, "empty", lambda *_: pytest.fail("allocated"))
    with pytest.raises(MemoryLimitError, match=r"the geometry of 24 patches needs 1\.406 KiB"):
        FormFactor(patches, device=device)
