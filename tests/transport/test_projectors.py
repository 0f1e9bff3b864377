# SPDX-License-Identifier: BSD-3-Clause
"""Several projectors as one: places of patterns, direct light, weights, gamut and refusals."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import InputError, InputTypeError
from ltcl.transport.projectors.direct_parts import direct_parts
from ltcl.transport.projectors.montage import Montage
from tests.transport import projectors
from tests.transport.projectors import CAMERA, LEFT, RIGHT

random = np.random.default_rng(7)


@pytest.fixture(scope="module")
def S():
    return projectors.corner()


@pytest.fixture(scope="module")
def members(device, S):
    return projectors.transports(device, S)


@pytest.fixture(scope="module")
def T(members):
    return ltcl.combine(members)


@pytest.mark.parametrize("lead", [(), (2,)])
@pytest.mark.parametrize("ending", [(), (3,)])
def test_patterns_side_by_side(lead, ending):
    montage = Montage(((2, 3), (4, 1), (3, 2)))
    patterns = [random.random((*lead, *grid, *ending)) for grid in montage.grids]
    picture = montage.join(patterns)
    assert picture.shape == (*lead, 4, 6, *ending)
    for pattern, found in zip(patterns, montage.split(picture), strict=True):
        np.testing.assert_array_equal(found, pattern)
    vectors = [random.random(h * w) for h, w in montage.grids]
    whole = montage.vector(vectors)
    assert not whole[montage.is_empty].any()
    for places, vector in zip(montage.places, vectors, strict=True):
        np.testing.assert_array_equal(whole[places], vector)


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
def test_pictures_add_up(device, members, form):
    kept = []
    for T in members:
        matrix = form(T.matrices[0])
        kept.append(ltcl.Transport(matrix, T.grid, camera_grid=CAMERA, device=device))
    combined = ltcl.combine(kept)
    patterns = [random.random(T.grid) for T in members]
    wanted = sum(T @ pattern for T, pattern in zip(members, patterns, strict=True))
    np.testing.assert_allclose(combined @ patterns, wanted, rtol=1e-5)
    np.testing.assert_allclose(ltcl.relight(combined, combined.join(patterns)), wanted, rtol=1e-5)


def test_direct_light_is_found(T):
    crease = CAMERA[1] // 2
    columns = np.arange(np.prod(CAMERA)) % CAMERA[1]
    # Beside the crease, light that bounced across it is near, too.
    is_plain = np.abs(columns - crease + 0.5) > 3
    for share, projector in zip(T.shares, (LEFT, RIGHT), strict=True):
        true = projector.direct()
        is_whole = true.sum(axis=1) > 0.9 * true.sum(axis=1).max()
        rows = is_whole & is_plain
        error = share.direct[0].toarray()[rows] - true[rows]
        assert np.linalg.norm(error) < 0.03 * np.linalg.norm(true[rows])


def test_direct_light_beside_a_crease_is_as_wide_as_elsewhere():
    """Pixels of the projector are those of the camera, as scans of several projectors have them."""
    grid = (12, 24)
    scene = ltcl.scenes.dihedral(12, albedo=0.7)
    S = scene.transport().to_numpy().astype(np.float64) / 0.7
    blur = []
    for pixels in grid:
        blur.append(np.eye(pixels) + 0.06 * (np.eye(pixels, k=1) + np.eye(pixels, k=-1)))
    F = np.kron(*blur)
    (found,) = direct_parts([S @ F], grid)
    lights = found.sum(axis=1).reshape(grid)
    true = F.sum(axis=1).reshape(grid)
    np.testing.assert_allclose(lights, true, rtol=0.11)
    bounced = found.toarray() - F
    assert np.linalg.norm(bounced) < 0.03 * np.linalg.norm(F)


@pytest.mark.parametrize(("blend", "largest"), [("smooth", 0.05), ("linear", 0.15)])
def test_weights_fall_at_borders(members, blend, largest):
    T = ltcl.combine(members, blend=blend)
    left, right = (
        share.own.reshape(p.grid) for share, p in zip(T.shares, (LEFT, RIGHT), strict=True)
    )
    middle = LEFT.grid[0] // 2
    assert left[middle, -1] < largest
    assert right[middle, 0] < largest
    # Where no other projector takes over, there is no border.
    np.testing.assert_allclose(left[2:-2, 2], 1.0, atol=1e-6)
    assert (np.diff(left[middle, 6:]) <= 1e-9).all()
    relative = np.stack([share.relative for share in T.shares])
    np.testing.assert_allclose(relative.max(axis=0), 1.0)


@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_balance_is_a_ceiling(members, balance):
    T = ltcl.combine(members, balance=balance)
    for share in T.shares:
        is_strong = share.own >= max(balance, 1e-12)
        np.testing.assert_allclose(share.ceiling[is_strong], 1.0)
        if balance > 0.0:
            weak = ~is_strong
            np.testing.assert_allclose(share.ceiling[weak], share.own[weak] / balance)


def test_shared_light_is_direct(T):
    smooth = np.full((CAMERA[0] * CAMERA[1], 1), 0.25)
    (pattern,) = T.share_light([smooth])
    patterns = T.split(pattern.reshape(T.grid))
    seen = LEFT.direct() @ patterns[0].ravel() + RIGHT.direct() @ patterns[1].ravel()
    inner = np.zeros(CAMERA, bool)
    inner[2:-2, 2:5] = True
    inner[2:-2, -5:-2] = True
    np.testing.assert_allclose(seen.reshape(CAMERA)[inner], smooth[0, 0], rtol=0.05)


@pytest.mark.parametrize(("shared", "power"), [(8, 1.0), (24, 2.0)])
def test_narrow_overlaps_have_linear_weights(shared, power):
    """Two projectors side by side on one row of camera pixels, of which they share some."""
    alone = 20
    width = alone + shared
    camera = (4, 2 * alone + shared)
    members = []
    for first in (0, alone):
        matrix = np.zeros((*camera, 4, width), np.float32)
        for row in range(4):
            columns = np.arange(width)
            matrix[row, first + columns, row, columns] = 0.5
        size = camera[0] * camera[1]
        matrix = matrix.reshape(size, 4 * width)
        members.append(ltcl.Transport(matrix, (4, width), camera_grid=camera))
    ramp = ltcl.combine(members).shares[0].ramp.reshape(4, width)
    named = {1.0: "linear", 2.0: "smooth"}[power]
    expected = ltcl.combine(members, blend=named).shares[0].ramp.reshape(4, width)
    np.testing.assert_array_equal(ramp, expected)
    distance = ramp[1] ** (1.0 / power)
    np.testing.assert_allclose(np.diff(distance[alone + 2 : -1]), -1.0)


@pytest.mark.parametrize("inner", [24, 12])
def test_a_projector_inside_of_another_ends_softly(inner):
    """The outer one, which never has to fade out, gives all of its light everywhere."""
    camera = (4, 60)
    size = camera[0] * camera[1]
    first = (camera[1] - inner) // 2
    identity = np.eye(size, dtype=np.float32).reshape(size, *camera)
    inside = identity[:, :, first : first + inner].reshape(size, -1)
    members = [
        ltcl.Transport(identity.reshape(size, size), camera, camera_grid=camera),
        ltcl.Transport(inside, (4, inner), camera_grid=camera),
    ]
    outer_share, inner_share = ltcl.combine(members).shares
    np.testing.assert_array_equal(outer_share.own, 1.0)
    np.testing.assert_array_equal(outer_share.ceiling, 1.0)
    own = inner_share.own.reshape(4, inner)
    assert own[1, 0] < 0.12
    assert own[1, -1] < 0.12
    assert own[1, inner // 2] > 0.9


def test_own_weights(members):
    weights = [np.ones(T.grid) for T in members]
    T = ltcl.combine(members, blend=weights)
    lit = np.all([share.white(0) > 0.1 for share in T.shares], axis=0)
    for share in T.shares:
        np.testing.assert_allclose(share.relative[lit], 1.0)


def test_common_gamut(device, S):
    mixings = [
        np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.1, 1.0]]),
        np.array([[0.8, 0.0, 0.1], [0.2, 0.7, 0.0], [0.1, 0.0, 1.1]]),
    ]
    members = []
    for projector, mixing in zip((LEFT, RIGHT), mixings, strict=True):
        matrix = (S @ projector.direct()).astype(np.float32)
        member = ltcl.Transport(
            [matrix] * 3, projector.grid, camera_grid=CAMERA, mixing=mixing, device=device
        )
        members.append(member)
    gamut = ltcl.combine(members).gamut
    for own in gamut.projectors:
        light = np.linalg.solve(own, gamut.primaries)
        assert light.min() >= -1e-9
        assert light.sum(axis=1).max() <= 1.0 + 1e-9
    np.testing.assert_allclose(gamut.light(np.ones((1, 1, 3)))[0, 0], gamut.white)
    assert 0.0 < gamut.differences.max() < 1.0
    assert "projector 2" in str(gamut)


def test_rims_are_not_the_light_of_a_projector(device, S):
    """Each lights the pixels at its rim in part, which are more than one in twenty."""
    scene = ltcl.Transport(S.astype(np.float32), CAMERA, device=device)
    gains = [1.0, 1.4, 0.8]
    members = []
    for gain, left, right in zip(gains, (-0.1, 0.28, 0.62), (0.43, 0.77, 1.1), strict=True):
        projector = projectors.Projector(grid=(10, 9), left=left, right=right, gain=gain)
        direct = scipy.sparse.csr_array(projector.direct().astype(np.float32))
        members.append(ltcl.Transport(direct, (10, 9), camera_grid=CAMERA, device=device))
    gamut = ltcl.combine(members, scene=scene).gamut
    white = projectors.ALBEDO * np.array(gains)
    np.testing.assert_allclose(gamut.projectors.ravel(), white, rtol=0.02)
    np.testing.assert_allclose(gamut.white, white.min(), rtol=0.02)
    np.testing.assert_allclose(
        gamut.differences, np.abs(white - white.mean()) / white.mean(), atol=0.02
    )


def test_without_black_the_contrast_is_infinite(members):
    contrast = ltcl.combine(members, blacks=[np.zeros(CAMERA)] * 2).contrast
    assert contrast is not None
    assert np.isinf(contrast.measured)
    assert str(contrast).startswith("contrast inf")


def test_scene_between_camera_pixels(T, S):
    plain = np.abs(np.arange(CAMERA[1]) - CAMERA[1] / 2 + 0.5) > 3
    direct = np.ones(np.prod(CAMERA))
    true = (S @ direct - direct).reshape(CAMERA)
    found = (T.scene.to_numpy() @ direct - direct).reshape(CAMERA)
    # Light across the crease from the nearest pixels counts as direct, as it is not told apart.
    np.testing.assert_allclose(found[:, plain], true[:, plain], rtol=0.3)


def test_a_copy_is_alike(T):
    twin = copy.deepcopy(T)
    pattern = random.random(T.grid)
    np.testing.assert_allclose(twin @ pattern, T @ pattern, rtol=1e-6)
    np.testing.assert_array_equal(twin.ceilings, T.ceilings)


def test_refusals(device, members, T):
    one = members[0]
    other_camera = ltcl.Transport(np.ones((4, 4)), (2, 2), camera_grid=(1, 4), device=device)
    colour = ltcl.Transport([one.matrices[0]] * 3, one.grid, camera_grid=CAMERA, device=device)
    blocks = [[one.matrices[0]] * 3] * 3
    coupled = ltcl.Transport(blocks, one.grid, camera_grid=CAMERA, device=device)
    black = np.zeros(CAMERA)
    cases: tuple[tuple[str, Any, dict[str, Any]], ...] = (
        ("1 members.*2 to 8", [one], {}),
        ("9 members", [one] * 9, {}),
        (r"transports\[1\].*camera_grid \(1, 4\)", [one, other_camera], {}),
        (r"transports\[1\].*channels 3", [one, colour], {}),
        (r"transports\[0\].*blocks", [coupled, coupled], {}),
        (r"transports\[1\].*combination", [one, T], {}),
        ("balance is 2", members, {"balance": 2}),
        ("blend is 'round'", members, {"blend": "round"}),
        ("blend .*2 projectors", members, {"blend": [np.ones(one.grid)]}),
        (r"blend\[1\] has shape", members, {"blend": [np.ones((10, 13))] * 2}),
        ("weights must be at least 0", members, {"blend": [-np.ones(m.grid) for m in members]}),
        ("black is 'lifted'", members, {"black": "lifted"}),
        ("blacks is None", members, {"black": "uniform"}),
        ("blacks has 1 pictures", members, {"blacks": [black]}),
        ("scene has grid", members, {"scene": ltcl.Transport(np.eye(4), (2, 2), device=device)}),
    )
    for match, transports, options in cases:
        with pytest.raises(InputError, match=match):
            ltcl.combine(transports, **options)
    with pytest.raises(InputTypeError, match="list of"):
        ltcl.combine(one)
    with pytest.raises(InputTypeError, match=r"transports\[1\] is a int"):
        ltcl.combine([one, 3])  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match=r"3 patterns.*2 projectors"):
        T.join([np.ones(one.grid)] * 3)
    with pytest.raises(InputError, match=r"pattern\[1\] has shape"):
        T.join([np.ones(one.grid)] * 2)
    with pytest.raises(InputError, match="frames and colours"):
        T.join([np.ones(LEFT.grid), np.ones((*RIGHT.grid, 3))])
    for call in (ltcl.align, ltcl.compress):
        with pytest.raises(InputError, match=r"T is of several projectors, .*separate"):
            call(T)
