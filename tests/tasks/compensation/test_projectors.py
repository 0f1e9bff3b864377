# SPDX-License-Identifier: BSD-3-Clause
"""Compensation, bounces and analysis of several projectors, against float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.optimize import lsq_linear, nnls

import ltcl
from ltcl.errors import InputError
from tests.transport import projectors
from tests.transport.projectors import ALBEDO, CAMERA, LEFT, RIGHT

PIXELS = CAMERA[0] * CAMERA[1]
y, x = np.mgrid[: CAMERA[0], : CAMERA[1]]
DESIRED = 0.25 + 0.1 * np.sin(0.6 * x) * np.cos(0.5 * y)


@pytest.fixture(scope="module")
def S():
    return projectors.corner()


@pytest.fixture(scope="module")
def members(device, S):
    return projectors.transports(device, S)


@pytest.fixture(scope="module")
def T(members):
    return ltcl.combine(members)


def coloured(device, S, mixings) -> ltcl.CombinedTransport:
    members = []
    for projector, mixing in zip((LEFT, RIGHT), mixings, strict=True):
        matrices = []
        for albedo in (1.0, 0.8, 0.6):
            matrices.append((albedo * S @ projector.direct()).astype(np.float32))
        member = ltcl.Transport(
            matrices, projector.grid, camera_grid=CAMERA, mixing=mixing, device=device
        )
        members.append(member)
    return ltcl.combine(members)


MIXINGS = (
    np.array([[1.0, 0.1, 0.0], [0.05, 1.0, 0.1], [0.0, 0.1, 1.0]]),
    np.array([[0.9, 0.0, 0.1], [0.1, 0.8, 0.0], [0.0, 0.0, 1.0]]),
)


def test_the_sum_is_the_picture(T, members):
    c = ltcl.compensate(T, DESIRED, rtol=1e-3)
    assert [pattern.shape for pattern in c.patterns] == [LEFT.grid, RIGHT.grid]
    seen = sum(m @ pattern for m, pattern in zip(members, c.patterns, strict=True))
    assert np.linalg.norm(seen - DESIRED) < 2e-3 * np.linalg.norm(DESIRED)
    assert c.error < 2e-3
    for pattern, share in zip(c.patterns, T.shares, strict=True):
        assert pattern.min() >= 0.0
        assert (pattern.ravel() <= share.ceiling * (1 + 1e-6)).all()


@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_the_best_within_the_bounds(members, balance):
    T = ltcl.combine(members, balance=balance)
    target = 3.0 * DESIRED
    c = ltcl.compensate(T, target, rtol=1e-3)
    assert T.ceilings is not None
    upper = np.maximum(T.ceilings, 1e-9)
    best = lsq_linear(T.to_numpy(), target.ravel(), (0.0, upper), method="bvls", tol=1e-12)
    least = np.sqrt(2.0 * best.cost) / np.linalg.norm(target)
    assert c.clipped > 0.1
    assert least - 1e-6 <= c.error <= least + 0.005
    assert c.gap < 2e-3


def test_two_are_twice_as_bright(device, S):
    stacked = []
    for blur in (0.5, 0.6):
        projector = projectors.Projector(grid=(10, 19), blur=blur)
        matrix = (S @ projector.direct()).astype(np.float32)
        stacked.append(ltcl.Transport(matrix, projector.grid, camera_grid=CAMERA, device=device))
    alone = [ltcl.compensate(T, DESIRED, gain="auto").gain for T in stacked]
    both = ltcl.compensate(ltcl.combine(stacked), DESIRED, gain="auto")
    assert both.gain > 1.8 * max(alone)
    assert both.error < 0.02


def test_a_picture_out_of_reach_is_given_up_in_time(T):
    """Its least error needs solves that come to no end: what they tell in few steps is enough."""
    desired = np.random.default_rng(0).uniform(0.05, 0.9, CAMERA)
    c = ltcl.compensate(T, desired, gain="auto")
    _, missing = nnls(T.to_numpy()[:, T.ceilings > 0.0].astype(np.float64), desired.ravel())
    least = missing / np.linalg.norm(desired)
    assert c.error == pytest.approx(1.1 * least, rel=0.03)
    assert c.limited[0].products < 8000


def test_bounds_of_each_projector(T):
    c = ltcl.compensate(T, 3 * DESIRED, bounds=(0.1, 0.6))
    for pattern, share in zip(c.patterns, T.shares, strict=True):
        assert pattern.min() >= np.float32(0.1)
        assert (pattern.ravel() <= 0.1 + 0.5 * share.ceiling + 1e-6).all()


def test_direct_light_in_camera_pixels(T, S):
    image = DESIRED
    b = ltcl.separate(T, image, bounces=2)
    assert b.direct.shape == CAMERA
    np.testing.assert_allclose(b.direct + b.bounces.sum(axis=0) + b.rest, image, rtol=1e-5)
    true = np.linalg.solve(S, image.ravel()).reshape(CAMERA)
    away = [0, 1, 2, 3, 4, -5, -4, -3, -2, -1]
    np.testing.assert_allclose(b.direct[:, away], true[:, away], rtol=0.05)


@pytest.mark.parametrize("mixings", [(None, None), (MIXINGS[0],) * 2, MIXINGS])
def test_colours(device, S, mixings):
    T = coloured(device, S, mixings)
    desired = np.stack([0.9 * DESIRED, DESIRED[::-1], 0.8 * DESIRED[:, ::-1]], axis=-1)
    c = ltcl.compensate(T, 0.6 * desired, rtol=2e-3)
    assert c.error < 4e-3
    assert c.pattern.shape == (*T.grid, 3)
    np.testing.assert_allclose(T @ list(c.patterns), c.appearance, rtol=1e-4, atol=1e-6)
    b = ltcl.separate(T, c.appearance, bounces=1)
    assert b.direct.shape == (*CAMERA, 3)
    auto = ltcl.compensate(T, desired, gain="auto")
    assert auto.error < 0.02


def test_frames(T):
    frames = np.stack([DESIRED, DESIRED[:, ::-1]])
    c = ltcl.compensate(T, frames)
    assert [pattern.shape for pattern in c.patterns] == [(2, *LEFT.grid), (2, *RIGHT.grid)]
    assert c.frame_errors.max() < 0.02


@pytest.mark.parametrize("clamp", [False, True])
def test_prepared_frames(T, clamp):
    with ltcl.Compensator(T, encode="linear", dtype="float32", clamp=clamp) as compensator:
        light = compensator(DESIRED.astype(np.float32))
        judged = compensator.judge()
    seen = T @ list(T.split(light))
    error = np.linalg.norm(seen - DESIRED) / np.linalg.norm(DESIRED)
    assert error == pytest.approx(judged.error, abs=1e-3)
    # Light that is shared, and clamped, is a little blurred.
    assert error < (0.1 if clamp else 0.011)
    for pattern, share in zip(T.split(light), T.shares, strict=True):
        assert (pattern.ravel() <= share.ceiling + 1e-5).all()


def test_bounds_of_prepared_frames_that_are_set(T):
    frame = DESIRED.astype(np.float32)
    settings: dict[str, Any] = {"encode": "linear", "dtype": "float32", "clamp": True}
    compensator = ltcl.Compensator(T, **settings)
    compensator(frame)
    compensator.bounds = (0.0, 0.5)
    fresh = ltcl.Compensator(T, bounds=(0.0, 0.5), **settings)
    np.testing.assert_allclose(compensator(frame), fresh(frame), rtol=0, atol=1e-6)


def test_prepared_mixed_colours(device, S):
    T = coloured(device, S, MIXINGS)
    desired = np.repeat(0.5 * DESIRED[..., None], 3, axis=-1).astype(np.float32)
    with ltcl.Compensator(T, encode="linear", dtype="float32") as compensator:
        light = compensator(desired)
    assert np.linalg.norm(T @ light - desired) < 0.02 * np.linalg.norm(desired)
    with ltcl.Compensator(T, encode="linear", dtype="float32", clamp=True) as compensator:
        light = compensator(desired)
    assert np.linalg.norm(T @ light - desired) < 0.1 * np.linalg.norm(desired)


def test_uniform_black(device, members):
    blacks = [np.full(CAMERA, 0.01), np.where(x >= 6, 0.015, 0.0)]
    T = ltcl.combine(members, blacks=blacks, black="uniform")
    assert 0.025 <= T.black_level[0] <= 0.03
    c = ltcl.compensate(T, np.zeros(CAMERA), rtol=1e-3)
    seen = T @ c.pattern + sum(blacks)
    np.testing.assert_allclose(seen, T.black_level[0], rtol=0.02)
    assert T.contrast is not None
    assert T.contrast.uniform < T.contrast.measured
    assert "uniform black" in str(T.contrast)
    kept = ltcl.combine(members, blacks=blacks)
    c = ltcl.compensate(kept, DESIRED, rtol=1e-3)
    seen = kept @ c.pattern + sum(blacks)
    assert np.linalg.norm(seen - DESIRED) < 2e-3 * np.linalg.norm(DESIRED)


def test_s_of_the_scene_is_given(device, S):
    scene = ltcl.Transport(
        (ALBEDO * S).astype(np.float32), CAMERA, np.full(PIXELS, ALBEDO), device=device
    )
    members = []
    for projector in (LEFT, RIGHT):
        direct = scipy.sparse.csr_array(projector.direct())
        members.append(ltcl.Transport(direct, projector.grid, camera_grid=CAMERA, device=device))
    T = ltcl.combine(members, scene=scene)
    c = ltcl.compensate(T, DESIRED, rtol=1e-3)
    true = S @ sum(p.direct() @ q.ravel() for p, q in zip((LEFT, RIGHT), c.patterns, strict=True))
    assert np.linalg.norm(true - DESIRED.ravel()) < 2e-3 * np.linalg.norm(DESIRED)
    b = ltcl.separate(T, DESIRED, bounces=1)
    np.testing.assert_allclose(b.direct.ravel(), np.linalg.solve(S, DESIRED.ravel()), rtol=0.01)


def test_analysis_of_the_scene(T):
    a = ltcl.analyze(T)
    assert a.grid == CAMERA
    assert 0.0 < a.channels[0].spectral_radius < 1.0
    assert a.verdict.text


@pytest.mark.parametrize("mixings", [None, (MIXINGS[0],) * 2, MIXINGS])
@pytest.mark.parametrize("clamp", [False, True])
def test_an_inverse_of_the_scene(device, S, T, mixings, clamp):
    """Light is undone by one product, for pictures, bounces and frames, as by solves."""
    desired = DESIRED
    if mixings is not None:
        T = coloured(device, S, mixings)
        desired = np.repeat(0.5 * DESIRED[..., None], 3, axis=-1)
    inverse = ltcl.invert(T, rtol=1e-3, basis="pixels")
    assert inverse.grid == CAMERA
    with_it = ltcl.compensate(T, desired, inverse=inverse, clamp=clamp, rtol=1e-3)
    without = ltcl.compensate(T, desired, clamp=clamp, rtol=1e-3)
    assert with_it.error == pytest.approx(without.error, abs=2e-3)
    bounces = ltcl.separate(T, with_it.appearance, bounces=1, inverse=inverse)
    expected = ltcl.separate(T, with_it.appearance, bounces=1, rtol=1e-4)
    np.testing.assert_allclose(bounces.direct, expected.direct, atol=5e-3 * desired.max())
    options = {"encode": "linear", "dtype": "float32", "clamp": clamp}
    with (
        ltcl.Compensator(T, inverse=inverse, **options) as prepared,
        ltcl.Compensator(T, **options) as solved,
    ):
        frame = desired.astype(np.float32)
        light = prepared(frame)
        np.testing.assert_allclose(T @ light, T @ solved(frame), atol=0.02 * desired.max())
        assert prepared.statistics.products == 1


def test_an_inverse_of_another_scene_is_refused(device, T):
    other = ltcl.Transport(np.eye(PIXELS) * 0.5, CAMERA, device=device)
    with pytest.raises(InputError, match="inverse"):
        ltcl.compensate(T, DESIRED, inverse=ltcl.invert(other, basis="pixels"))


@pytest.mark.parametrize("clamp", [False, True])
def test_a_gain_that_follows(T, clamp):
    """The brightest light comes to the upper bound, from darker and from brighter frames."""
    brightness: list[float] = []
    with ltcl.Compensator(
        T, gain="follow", gain_change=1e6, fps=1.0, encode="linear", dtype="float32", clamp=clamp
    ) as compensator:
        for level in (0.2, 0.6, 0.05):
            frame = (level * DESIRED).astype(np.float32)
            compensator(frame)
            light = compensator(frame)
            assert light.max() == pytest.approx(1.0, abs=0.01)
            brightness.append(compensator.gain * level)
    np.testing.assert_allclose(brightness, brightness[0], rtol=1e-4)


@pytest.mark.parametrize("mixings", [None, (MIXINGS[0],) * 2, MIXINGS])
def test_a_gain_that_follows_colours(device, S, mixings):
    T = coloured(device, S, mixings if mixings is not None else (None, None))
    frame = np.repeat(0.3 * DESIRED[..., None], 3, axis=-1).astype(np.float32)
    with ltcl.Compensator(
        T, gain="follow", gain_change=1e6, encode="linear", dtype="float32", clamp=True
    ) as compensator:
        compensator(frame)
        light = compensator(frame)
        gain = compensator.statistics.gain
    assert light.max() == pytest.approx(1.0, abs=0.03)
    seen = T @ light
    assert np.linalg.norm(seen - gain * frame) < 0.1 * np.linalg.norm(gain * frame)


@pytest.mark.parametrize("name", ["gain", "clamp", "inverse"])
def test_a_darkest_light_takes_the_bounds_alone(T, name):
    """One line that says why; compensate itself takes an inverse."""
    inverse = ltcl.invert(T, rtol=1e-2, basis="pixels")
    options = {
        "gain": {"gain": "follow"},
        "clamp": {"clamp": True},
        "inverse": {"inverse": inverse},
    }
    with pytest.raises(InputError, match=f"{name} is .* bounds"):
        ltcl.Compensator(T, bounds=(0.1, 1.0), **options[name])
    assert ltcl.compensate(T, DESIRED, bounds=(0.01, 1.0), inverse=inverse).error < 0.02


def test_bounces_of_several_projectors_are_those_of_each_frame(T):
    with pytest.raises(InputError, match="bounces_every is 3, but T has several projectors"):
        ltcl.Compensator(T, bounces_every=3)
