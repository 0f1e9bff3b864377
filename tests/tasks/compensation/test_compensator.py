# SPDX-License-Identifier: BSD-3-Clause
"""Prepared frames: the codes of `compensate`, whatever T and codes they are of."""

from __future__ import annotations

import copy
import logging
import pickle
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError, InputTypeError
from ltcl.images.encoding import from_srgb, to_srgb
from ltcl.tasks.compensation import prepared
from ltcl.tasks.compensation.codes import CodeTable, code_table
from tests import reference

GRID = (4, 6)
N = 24
rng = np.random.default_rng(8)


def dense(seed: int, n: int = N, strength: float = 0.5) -> np.ndarray:
    """T of n pixels whose bounces add `strength` of the direct light."""
    random = np.random.default_rng(seed)
    T = random.uniform(0.0, 2.0 * strength / n, (n, n))
    np.fill_diagonal(T, random.uniform(0.5, 1.0, n))
    return T


def transport(kind: str) -> ltcl.Transport:
    """One of each kind of transport."""
    three = [dense(seed) for seed in range(3)]
    mixing = [[1.0, 0.1, 0.0], [0.05, 1.0, 0.1], [0.0, 0.05, 1.0]]
    if kind == "grey":
        return ltcl.Transport(dense(0), GRID)
    if kind == "colour":
        return ltcl.Transport(three, GRID)
    if kind == "sparse":
        sparse = []
        for T in three:
            sparse.append(scipy.sparse.csr_array(np.where(T > 0.02, T, 0.0)))
        return ltcl.Transport(sparse, GRID)
    if kind == "masked":
        for T in three:
            T[:, 3] = 0.0
        return ltcl.Transport(three, GRID)
    if kind == "mixed colours":
        return ltcl.Transport(three, GRID, mixing=mixing)
    if kind == "blocks":
        blocks = [[dense(3 * c + d) * (1.0 if c == d else 0.1) for d in range(3)] for c in range(3)]
        return ltcl.Transport(blocks, GRID)
    if kind == "other camera":
        return ltcl.Transport([T[:20] for T in three], GRID, camera_grid=(4, 5))
    assert kind == "compressed"
    scene = ltcl.scenes.dihedral(8, albedo=(0.6, 0.5, 0.3))
    return ltcl.compress(scene.transport(), rtol=1e-3, basis="db2")


SQUARE = ("grey", "colour", "sparse", "masked", "mixed colours", "compressed")
KINDS = (*SQUARE, "blocks", "other camera")


def picture(T: ltcl.Transport, brightest: float, seed: int = 1) -> np.ndarray:
    """Linear light that the projector reaches if it is dim enough."""
    shape = (*T.camera_grid, 3) if T.channels == 3 else T.camera_grid
    noise = np.random.default_rng(seed).uniform(0.5, 1.0, shape)
    return (brightest * noise).astype(np.float32)


def light(T: ltcl.Transport, **settings: Any) -> ltcl.Compensator:
    """A compensator of linear light."""
    curves = {"encode": "linear", "dtype": "float32"}
    return ltcl.Compensator(T, **{**curves, **settings})


@pytest.fixture(autouse=True)
def quiet(caplog):
    caplog.set_level(logging.ERROR)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("brightest", [0.4, 2.0], ids=["within reach", "beyond the bounds"])
def test_light_of_compensate(kind, brightest):
    """The same light, or light of an error that is as small."""
    T = transport(kind)
    desired = picture(T, brightest)
    compensator = light(T, rtol=1e-3)
    pattern = compensator(desired)
    expected = ltcl.compensate(T, desired, rtol=1e-3)
    assert pattern.shape == expected.pattern.shape
    assert pattern.min() >= 0.0
    assert pattern.max() <= 1.0
    is_lit = ~T.unlit.reshape(T.camera_grid)
    appearance = (T @ pattern)[is_lit]
    error = np.linalg.norm(appearance - desired[is_lit]) / np.linalg.norm(desired[is_lit])
    assert error <= expected.error + 2.5e-3
    facts = compensator.judge()
    assert facts.error == pytest.approx(error, abs=1e-5)
    assert facts.clipped == pytest.approx(expected.clipped, abs=0.1)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "weighted", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["plain", "weighted"]
)
def test_a_frame_and_compensate_take_the_same_steps(kind, weighted):
    """From the same light, both end at the same pattern, to rounding."""
    T = transport(kind)
    desired = picture(T, 2.0)
    settings: dict[str, Any] = {"gain": 0.9, "background": 0.05, "bounds": (0.0, 0.8), "rtol": 1e-3}
    if kind in SQUARE:
        settings["inverse"] = ltcl.invert(T, 1e-3)
    if weighted:
        settings["weights"] = picture(T, 2.0, seed=7)
    compensator = light(T, **settings)
    pattern = compensator(desired)
    expected = ltcl.compensate(T, desired, **settings)
    assert expected.clipped > 0.1
    np.testing.assert_allclose(pattern, expected.pattern, rtol=0, atol=1e-5)
    facts = compensator.judge()
    assert facts.error == pytest.approx(expected.error, abs=1e-6)
    assert facts.clipped == pytest.approx(expected.clipped, abs=1e-6)


@pytest.mark.parametrize("kind", SQUARE)
@pytest.mark.parametrize(
    "has_inverse", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["steps", "inverse"]
)
def test_clamped_light(kind, has_inverse):
    """That of `compensate` with clamp, by steps or by an inverse, with background and gain."""
    T = transport(kind)
    desired = picture(T, 1.2)
    settings: dict[str, Any] = {"gain": 0.9, "background": 0.05, "bounds": (0.1, 0.8)}
    settings |= {"rtol": 1e-3, "clamp": True}
    if has_inverse:
        settings["inverse"] = ltcl.invert(T, 1e-3)
    compensator = light(T, **settings)
    pattern = compensator(desired)
    expected = ltcl.compensate(T, desired, **settings)
    np.testing.assert_allclose(pattern, expected.pattern, rtol=0, atol=4e-3)
    facts = compensator.judge()
    assert facts.error == pytest.approx(expected.error, abs=2e-3)
    assert facts.clipped == pytest.approx(expected.clipped, abs=0.02)


def test_background_of_each_pixel():
    T = transport("colour")
    dark = picture(T, 0.1, seed=5)
    desired = picture(T, 0.6)
    pattern = light(T, background=dark, rtol=1e-4, clamp=True)(desired)
    expected = ltcl.compensate(T, desired, background=dark, rtol=1e-4, clamp=True).pattern
    np.testing.assert_allclose(pattern, expected, rtol=0, atol=1e-3)


@pytest.mark.parametrize("kind", ["grey", "colour", "blocks"])
def test_weighted_pixels_count(kind):
    """Where light is short, that goes where the weights are."""
    T = transport(kind)
    desired = picture(T, 1.5)
    weights = np.ones(T.camera_grid)
    weights[:2] = 10.0
    compensator = light(T, weights=weights, rtol=1e-3)
    compensator(desired)
    expected = ltcl.compensate(T, desired, weights=weights, rtol=1e-3)
    assert compensator.judge().error <= expected.error + 2e-3


@pytest.mark.parametrize("colours", [1, 3])
@pytest.mark.parametrize("kind", ["grey", "colour"])
def test_frames_grey_and_coloured(kind, colours):
    """Grey frames on a T in colour are of three equal colours; a grey T takes each colour."""
    T = transport(kind)
    shape = (*GRID, 3) if colours == 3 else GRID
    frame = rng.uniform(0.1, 0.4, shape).astype(np.float32)
    pattern = light(T, rtol=1e-4)(frame)
    expected = ltcl.compensate(T, frame, rtol=1e-4).pattern
    assert pattern.shape == expected.shape
    np.testing.assert_allclose(pattern, expected, rtol=0, atol=1e-3)


# Codes.


@pytest.mark.parametrize("frame_dtype", ["uint8", "uint16", "float32", "float64"])
@pytest.mark.parametrize("decode", ["auto", "srgb", "linear"])
def test_codes_of_frames_are_light(frame_dtype, decode):
    T = ltcl.Transport(np.diag(np.ones(N)), GRID)
    frame = rng.uniform(0.0, 1.0, GRID)
    if frame_dtype.startswith("uint"):
        largest = np.iinfo(frame_dtype).max
        codes = np.rint(largest * frame).astype(frame_dtype)
        frame = codes / largest
    else:
        codes = frame.astype(frame_dtype)
    pattern = light(T, decode=decode, rtol=1e-5)(codes)
    is_srgb = decode == "srgb" or (decode == "auto" and codes.dtype.kind == "u")
    expected = from_srgb(frame) if is_srgb else frame
    np.testing.assert_allclose(pattern, expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("curve", ["srgb", "linear", "response", "three responses"])
def test_codes_of_light(dtype, curve):
    """Each is the nearest to the light, on any rising curve, up to rounding of the light."""
    T = ltcl.Transport([np.diag(np.ones(N))] * 3, GRID)
    values = np.linspace(0.0, 1.0, 33) ** np.array([[2.2], [1.8], [2.6]])
    encode: Any = curve
    if curve == "response":
        encode = Response(values[0])
    elif curve == "three responses":
        encode = Response(values)
    pattern = rng.uniform(0.0, 1.0, (*GRID, 3)).astype(np.float32)
    codes = light(T, encode=encode, dtype=dtype, rtol=1e-6)(pattern)
    assert codes.dtype == dtype
    expected = pattern
    if curve == "srgb":
        expected = to_srgb(pattern)
    elif curve != "linear":
        expected = encode.codes(pattern)
    largest = 1 if dtype == "float32" else np.iinfo(dtype).max
    np.testing.assert_allclose(
        codes / largest, expected, rtol=0, atol=0.51 / largest + 2e-5 if largest > 1 else 2e-5
    )


def test_white_of_codes():
    """Whole codes have white at the upper bound, floats are the light, responses know white."""
    T = ltcl.Transport(np.diag(np.ones(N)), GRID)
    frame = np.full(GRID, 0.25, np.float32)
    half = light(T, bounds=(0.0, 0.5), encode="linear", dtype="uint8")(frame)
    assert np.all(half == 128)
    assert np.allclose(light(T, bounds=(0.0, 0.5))(frame), 0.25)
    response = Response(np.array([0.0, 1.0]))
    known = light(T, bounds=(0.0, 0.5), encode=response, dtype="uint8")(frame)
    assert np.all(known == 64)


@pytest.mark.parametrize("dtype", ["uint8", "float32"])
def test_every_cell_has_its_places(dtype):
    """A table finds each threshold, whatever the curve: flat, steep, or with steps."""
    curves = {
        "srgb": lambda codes: from_srgb(codes),
        "steep": lambda codes: codes**4.0,
        "flat": lambda codes: np.clip(codes, 0.2, 0.6),
        "below 0": lambda codes: codes - 0.1,
    }
    for curve in curves.values():
        table = CodeTable.of_curves([curve], dtype)
        row = table.thresholds[0, :-1]
        probes = np.concatenate([row, np.nextafter(row, -np.inf), [-1.0, 2.0]])
        probes = probes.astype(np.float32)
        cells = (probes - table.first_light) * np.float32(table.cells_per_light)
        places = table.starts[0][np.clip(cells, 0, table.starts.shape[1] - 1).astype(int)]
        for bit in reversed(range(table.steps)):
            following = np.minimum(places + (1 << bit), len(row) + 1)
            places = places + (1 << bit) * (probes >= table.thresholds[0][following - 1])
        np.testing.assert_array_equal(places, np.searchsorted(row, probes, side="right"))


@pytest.mark.parametrize("kind", ["grey", "colour", "masked", "mixed colours"])
def test_kernels_meet_their_twins(shaped, kind, monkeypatch):
    monkeypatch.setattr(prepared, "STRIP_PIXELS", 5)
    known = transport(kind)
    T = ltcl.Transport(known.matrices, GRID, device=shaped, mixing=known.mixing)
    compensator = ltcl.Compensator(
        T, gain="follow", background=0.1, bounds=(0.1, 0.8), bounces_every=2
    )
    colours = T.channels
    frames = compensator._frames_of(colours, np.dtype(np.uint8))
    assert frames.bounded is not None
    codes = rng.integers(0, 256, (N, colours), dtype=np.uint8)
    slot = frames.slots[0]
    slot.frame.array.set(codes)
    slot.decode.set(gain=0.7 / frames.unit)
    slot.decode()
    table = from_srgb(np.arange(256) / 255)
    expected = reference.frames_decode(codes, table, 0.7, np.full((N, colours), 0.1))
    found = frames.seen.to_channels(frames.target.get())
    np.testing.assert_allclose(frames.unit * found, expected, rtol=0, atol=1e-6)

    kept = frames._kept_bounces
    assert kept is not None
    assert kept.background is not None
    bounces = rng.uniform(-0.4, 0.0, frames.shown.shape).astype(np.float32)
    kept.light.set(bounces)
    assert slot.decode_between is not None
    slot.decode_between.set(gain=0.7 / frames.unit, share=0.9)
    slot.decode_between()
    background_bounces = frames.shown.to_channels(kept.background.get())
    between = reference.frames_between(
        expected / frames.unit, frames.shown.to_channels(bounces), 0.9
    )
    found = frames.shown.to_channels(frames.direct.get())
    np.testing.assert_allclose(found, between - background_bounces, rtol=0, atol=1e-6)
    np.testing.assert_allclose(
        frames.unit * frames.seen.to_channels(frames.target.get()), expected, rtol=0, atol=1e-6
    )

    direct = rng.uniform(-0.3, 1.3, frames.shown.shape).astype(np.float32)
    frames.direct.set(direct)
    mixing = np.eye(colours) if T.mixing is None else np.linalg.inv(T.mixing)
    factors = frames.shown.to_channels(frames._direct_factors.get())
    light = reference.frames_light(factors, frames.shown.to_channels(direct), mixing)
    np.testing.assert_allclose(
        frames.shown.to_channels(frames.light_of_direct(frames.direct)), light, rtol=0, atol=1e-6
    )
    frames._exceeded.set(np.zeros(1, np.int32))
    frames._clip()
    scales = frames.shown.to_channels(frames._scales())
    is_outside = ((light < 0.1) | (light > 0.8)) & (scales > 0)
    assert frames._exceeded.get()[0] == np.count_nonzero(is_outside)
    expected = reference.frames_clip(light, 0.1, 0.8, scales)
    found = frames.shown.to_channels(frames.bounded.start.get())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)

    # The unknowns become codes.
    frames.bounded.x.copy_from(frames.bounded.start)
    slot.encode()
    row = frames._table.thresholds[0, :-1]
    expected = reference.frames_encode(light, 0.1, 0.8, row)
    difference = slot.codes.array.get().astype(int) - expected
    is_lit = scales > 0
    assert np.abs(difference[is_lit]).max() <= 1
    assert np.mean(difference[is_lit] != 0) < 0.02
    assert not slot.codes.array.get()[~is_lit].any()

    assert frames._find_peaks is not None
    frames._find_peaks.set(peaks=slot.peaks.array)
    frames._find_peaks()
    target = frames.seen.to_channels(np.full(frames.seen.shape, 0.1 / frames.unit))
    columns = [t[:, None] for t in target.T]
    undone = []
    for channel, S in enumerate(T.systems):
        undone.append(np.linalg.solve(S.to_dense(), columns[channel])[:, 0])
    shift = reference.frames_light(factors, np.stack(undone, axis=-1), mixing)
    expected = reference.frames_peaks(light, 0.8, shift, 5)
    np.testing.assert_allclose(slot.peaks.array.get(), expected, rtol=0, atol=3e-3)


# Time.


def test_order_of_submitted_frames():
    T = transport("colour")
    frames = [picture(T, 0.1 * (1 + n % 5), seed=n) for n in range(12)]
    compensator = light(T, clamp=True)
    expected = [compensator(frame) for frame in frames]
    with light(T, clamp=True, depth=2) as pipelined:
        futures = [pipelined.submit(frame) for frame in frames]
        for future, codes in zip(futures, expected, strict=True):
            np.testing.assert_array_equal(future.result(), codes)
        assert pipelined.statistics.frames == 12


PINNED: dict[str, dict[str, Any]] = {
    "clamped": {"clamp": True},
    "within the bounds": {},
    "gain that follows": {"gain": "follow", "clamp": True},
    "cold": {"warm": False, "dtype": "uint8", "encode": "srgb"},
}


@pytest.mark.parametrize("case", PINNED)
@pytest.mark.parametrize("frame_dtype", ["uint8", "float32"])
def test_pinned_memory_gives_the_same_codes(monkeypatch, case, frame_dtype):
    """One by one, in a pipeline, and from the device, in turn."""
    T = transport("colour")
    frames = []
    for seed in range(8):
        frame = picture(T, 0.1 * (1 + seed % 5), seed=seed)
        frames.append((255 * frame).astype(np.uint8) if frame_dtype == "uint8" else frame)

    def codes(transfers: str) -> list[np.ndarray]:
        monkeypatch.setenv("LTCL_TRANSFERS", transfers)
        with light(T, depth=2, **PINNED[case]) as compensator:
            results = [compensator(frame) for frame in frames[:3]]
            # One by one where the gain follows what was collected before.
            if case == "gain that follows":
                results += [compensator.submit(frame).result() for frame in frames]
            else:
                futures = [compensator.submit(frame) for frame in frames]
                results += [future.result() for future in futures]
            on_device = T.device.upload(frames[3], frames[3].dtype)
            return [*results, compensator(on_device)]

    for expected, found in zip(codes("direct"), codes("pinned"), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_late_frames_are_dropped():
    """No more are on their way than asked; what is dropped is None, and counted."""
    T = transport("compressed")
    frame = picture(T, 0.3)
    with light(T, clamp=True, depth=1, late="drop") as compensator:
        results = [compensator.submit(frame).result for _ in range(20)]
        codes = [result() for result in results]
        dropped = sum(result is None for result in codes)
        statistics = compensator.statistics
        assert statistics.dropped == dropped
        assert statistics.frames == 20 - dropped
        assert codes[0] is not None


def test_no_time_is_the_clamped_pattern():
    """A deadline that is over gives the clamped pattern; more time is never worse."""
    T = transport("blocks")
    square = transport("colour")
    desired = picture(square, 2.0)
    clamped = light(square, clamp=True, rtol=1e-4)(desired)
    hurried = light(square, deadline_ms=1e-6, rtol=1e-4)
    np.testing.assert_allclose(hurried(desired), clamped, rtol=0, atol=1e-5)
    errors = [hurried.judge().error]
    for milliseconds in (20.0, 1e5):
        compensator = light(square, deadline_ms=milliseconds, rtol=1e-4)
        compensator(desired)
        errors.append(compensator.judge().error)
    assert errors[1] <= errors[0] + 1e-5
    assert errors[2] <= errors[1] + 1e-5
    # Without an S the first frame has no light to begin with, and still ends in time.
    light(T, deadline_ms=1e-6)(picture(T, 0.5))


def test_second_frame_begins_where_the_first_ended():
    """A still picture takes no further step, and its error does not rise."""
    T = transport("colour")
    desired = picture(T, 2.0)
    compensator = light(T, deadline_ms=1e-6, rtol=1e-6)
    errors = []
    for _ in range(30):
        compensator(desired)
        errors.append(compensator.judge().error)
    assert np.all(np.diff(errors) <= 1e-6)
    patient = light(T, rtol=1e-6)
    patient(desired)
    best = patient.judge().error
    patient(desired)
    assert patient.judge().error <= best + 1e-6


def test_cold_frames_do_not_depend_on_others():
    T = transport("colour")
    desired = picture(T, 2.0)
    compensator = light(T, warm=False, rtol=1e-2)
    first = compensator(desired)
    compensator(picture(T, 1.5, seed=9))
    np.testing.assert_array_equal(compensator(desired), first)


def test_launches_of_a_frame():
    """At most 14 with an inverse, and 14 and 2 a product with fixed steps."""
    scene = ltcl.scenes.dihedral(8, albedo=(0.6, 0.5, 0.3))
    small = ltcl.compress(scene.transport(), rtol=1e-2, basis="db2")
    device = small.device
    for inverse in (None, ltcl.invert(small, 1e-2)):
        compensator = ltcl.Compensator(small, clamp=True, inverse=inverse, rtol=2e-2)
        frame = np.full((*small.camera_grid, 3), 100, np.uint8)
        compensator(frame)
        before = device.launches.copy()
        compensator(frame)
        launches = (device.launches - before).total()
        products = compensator.statistics.products
        allowed = 14 if inverse is not None else 14 + 2 * products
        assert launches <= allowed


# Bounces of an earlier frame.


def undone(T: ltcl.Transport, light: np.ndarray) -> np.ndarray:
    """S^-1 of light (N, channels), in float64."""
    columns = []
    for S, column in zip(T.systems, light.T, strict=True):
        columns.append(np.linalg.solve(S.to_dense().astype(np.float64), column))
    return np.stack(columns, axis=-1)


# Kinds of T, and the tolerance of an inverse, or none.
BOUNCING = [*((kind, None) for kind in SQUARE), ("colour", 1e-3), ("compressed", 2e-3)]


@pytest.mark.parametrize(("kind", "inverse_rtol"), BOUNCING)
def test_bounces_of_every_second_frame(kind, inverse_rtol):
    """Codes as without the option, and in between those of the bounces of the frame before."""
    T = transport(kind)
    dark = 0.05
    settings: dict[str, Any] = {"background": dark, "rtol": 1e-4, "clamp": True}
    tolerance = 1e-3
    if inverse_rtol is not None:
        settings |= {"inverse": ltcl.invert(T, inverse_rtol), "rtol": inverse_rtol}
        tolerance += 2 * inverse_rtol
    whole = light(T, **settings)
    half = light(T, bounces_every=2, **settings)
    F = np.atleast_2d(T.first_bounce).T
    is_lit = (F > 0.0) & ~T.masked[:, None]
    factors = np.divide(1.0, F, out=np.zeros_like(F), where=is_lit)
    mixing = np.eye(T.channels) if T.mixing is None else np.linalg.inv(T.mixing)
    lights = []
    for number, gain in enumerate([1.0, 0.8, 1.1, 1.0]):
        desired = picture(T, 0.5, seed=number)
        half.gain = whole.gain = gain
        pattern = half(desired)
        lights.append(desired.reshape(-1, T.channels).astype(np.float64))
        if number % 2 == 0:
            np.testing.assert_array_equal(pattern, whole(desired))
            continue
        background = np.full_like(lights[-1], dark)
        target = gain * lights[-1] - background
        kept = gain * lights[-2] - background
        direct = reference.frames_between(target, undone(T, kept) - kept, 1.0)
        expected = reference.frames_light(factors, direct, mixing)
        found = pattern.reshape(expected.shape)
        np.testing.assert_allclose(found, np.clip(expected, 0.0, 1.0), atol=tolerance)
        # The frame before is another one, whose bounces are others.
        assert np.abs(found - whole(desired).reshape(expected.shape)).max() > 2e-3


def test_error_is_that_of_the_bounces_of_the_change():
    """S (b + e') - b is R (b - b'), which `judge` tells."""
    T = transport("grey")
    compensator = light(T, bounces_every=3, rtol=1e-5)
    first = picture(T, 0.3)
    second = picture(T, 0.4, seed=2)
    compensator(first)
    pattern = compensator(second)
    S = T.systems[0].to_dense().astype(np.float64)
    change = (second - first).ravel().astype(np.float64)
    expected = np.linalg.norm(S @ change - change) / np.linalg.norm(second)
    assert expected > 1e-2
    assert compensator.judge().error == pytest.approx(expected, rel=1e-3)
    appearance = T @ pattern
    found = np.linalg.norm(appearance - second) / np.linalg.norm(second)
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("settings", [{"clamp": True}, {}, {"gain": "follow"}])
@pytest.mark.parametrize("kind", ["colour", "compressed"])
def test_still_film_has_the_bounces_of_each_frame(kind, settings):
    """Codes of frames in between are the same, one by one, in a pipeline, and from the device."""
    T = transport(kind)
    frame = np.full((*T.camera_grid, 3), 100, np.uint8)
    frame[1:] = 90
    expected = ltcl.Compensator(T, **settings)(frame)
    with ltcl.Compensator(T, bounces_every=3, depth=2, **settings) as compensator:
        found = [compensator(frame) for _ in range(2)]
        found += [future.result() for future in [compensator.submit(frame) for _ in range(5)]]
        found.append(compensator(T.device.upload(frame, np.uint8)))
    for codes in found:
        np.testing.assert_array_equal(codes, expected)


def test_bounces_in_a_pipeline():
    """The order of frames decides, not when their codes are asked for."""
    T = transport("colour")
    frames = [picture(T, 0.1 * (1 + n % 5), seed=n) for n in range(9)]
    compensator = light(T, clamp=True, bounces_every=3)
    expected = [compensator(frame) for frame in frames]
    with light(T, clamp=True, bounces_every=3, depth=2) as pipelined:
        futures = [pipelined.submit(frame) for frame in frames]
        for future, codes in zip(futures, expected, strict=True):
            np.testing.assert_array_equal(future.result(), codes)


def test_kept_bounces_outlast_other_bounds():
    T = transport("colour")
    frame = picture(T, 0.8)
    compensator = light(T, bounces_every=3, clamp=True, gain="follow")
    expected = light(T, bounds=(0.1, 0.6), clamp=True)
    compensator(frame)
    compensator.bounds = (0.1, 0.6)
    found = compensator(frame)
    expected.gain = compensator.statistics.gain
    np.testing.assert_allclose(found, expected(frame), rtol=0, atol=1e-6)


def test_kept_bounces_are_not_older_than_frames_of_other_colours():
    T = transport("grey")
    compensator = light(T, bounces_every=2, clamp=True)
    expected = light(T, clamp=True)
    second = picture(T, 0.4, seed=2)
    compensator(picture(T, 0.1))
    for _ in range(3):
        compensator(np.repeat(second[..., None], 3, axis=-1))
    np.testing.assert_array_equal(compensator(second), expected(second))


def test_light_beyond_the_bounds_takes_steps_in_each_frame():
    """No frame in between is worse than `compensate` of it."""
    T = transport("colour")
    compensator = light(T, bounces_every=2, rtol=1e-3)
    for seed in range(4):
        desired = picture(T, 2.0, seed=seed)
        compensator(desired)
        expected = ltcl.compensate(T, desired, rtol=1e-3)
        assert compensator.judge().error <= expected.error + 2.5e-3


def test_frames_in_between_take_no_product():
    scene = ltcl.scenes.dihedral(8, albedo=(0.6, 0.5, 0.3))
    T = ltcl.compress(scene.transport(), rtol=1e-2, basis="db2")
    compensator = ltcl.Compensator(T, clamp=True, rtol=2e-2, bounces_every=2)
    frame = np.full((*T.camera_grid, 3), 100, np.uint8)
    compensator(frame)
    before = T.device.launches.copy()
    compensator(frame)
    assert (T.device.launches - before).total() == 2


@pytest.mark.parametrize("kind", ["blocks", "other camera"])
def test_bounces_need_an_S(kind):
    with pytest.raises(InputError, match="bounces_every is 2, but this T has no S"):
        ltcl.Compensator(transport(kind), bounces_every=2)


# Gain.


def test_gain_of_a_film():
    T = transport("colour")
    film = [picture(T, 0.3, seed=n) for n in range(4)]
    compensator = light(T, gain="auto", film=film)
    assert compensator.gain == pytest.approx(ltcl.compensate(T, np.stack(film), gain="auto").gain)


def test_gain_follows_the_content():
    """At the right gain at once, then after the content, no faster than allowed."""
    T = transport("grey")
    bright = picture(T, 0.8)
    dim = 0.25 * bright
    compensator = light(T, gain="follow", gain_change=2.0, fps=4.0, rtol=1e-4)
    pattern = compensator(bright)
    assert pattern.max() == pytest.approx(1.0, abs=0.02)
    gains = []
    for _ in range(16):
        compensator(dim)
        gains.append(compensator.statistics.gain)
    ratios = np.divide(gains[1:], gains[:-1])
    assert np.all(ratios <= 2.0**0.25 + 1e-6)
    assert np.all(ratios >= 1.0 - 1e-6)
    assert gains[-1] == pytest.approx(4.0 * gains[0], rel=0.02)
    # What is too bright is dimmed as slowly.
    compensator(bright)
    before = compensator.statistics.gain
    compensator(bright)
    assert compensator.statistics.gain == pytest.approx(before * 2.0**-0.25, rel=1e-5)


def test_a_gain_that_is_set_is_that_of_the_first_frame():
    T = transport("grey")
    frame = picture(T, 0.8)
    compensator = light(T, gain="follow")
    compensator.follows_gain = False
    compensator.gain = 0.25
    # Other bounds take other steps.
    compensator.bounds = (0.0, 0.9)
    expected = light(T, gain=0.25, bounds=(0.0, 0.9))(frame)
    np.testing.assert_allclose(compensator(frame), expected, rtol=1e-5, atol=1e-6)
    assert compensator.statistics.gain == 0.25
    compensator.follows_gain = True
    for _ in range(2):
        compensator(0.5 * frame)
    assert compensator.gain > 0.25


def test_gain_counts_the_background():
    T = transport("grey")
    frame = picture(T, 0.5)
    compensator = light(T, gain="follow", background=0.1, rtol=1e-5)
    assert compensator(frame).max() == pytest.approx(1.0, abs=0.02)


def test_dark_frames_keep_the_gain():
    T = transport("grey")
    compensator = light(T, gain="follow")
    assert not compensator(np.zeros(GRID)).any()
    assert compensator.gain == 1.0


# Arrays of the device, and places for results.


def test_frames_on_the_device():
    T = transport("colour")
    frame = picture(T, 0.4)
    compensator = light(T, clamp=True)
    expected = compensator(frame)
    on_device = T.device.upload(frame)
    np.testing.assert_array_equal(compensator(on_device), expected)
    place = T.device.empty(expected.shape)
    assert compensator(on_device, out=place) is place
    np.testing.assert_array_equal(place.get(), expected)
    out = np.empty_like(expected)
    assert compensator(frame, out=out) is out
    np.testing.assert_array_equal(out, expected)


def test_results_stay_theirs():
    """A later frame does not change the codes that were given before."""
    T = transport("grey")
    compensator = light(T, depth=1)
    first = compensator(picture(T, 0.4))
    kept = first.copy()
    compensator(picture(T, 0.2))
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("kind", ["other camera", "blocks", "colour"])
@pytest.mark.parametrize("bounds", [(0.5, 1.0), (-0.3, 0.7), (0.1, 0.15)])
def test_bounds_of_any_place(kind, bounds):
    """Also without 0, where the darkest light is no start, and with ends that float32 rounds."""
    T = transport(kind)
    desired = picture(T, 2.0)
    compensator = light(T, bounds=bounds, rtol=1e-3)
    pattern = compensator(desired)
    expected = ltcl.compensate(T, desired, bounds=bounds, rtol=1e-3)
    error = np.linalg.norm(T @ pattern - desired) / np.linalg.norm(desired)
    facts = compensator.judge()
    assert facts.error == pytest.approx(error, abs=1e-4)
    assert error <= expected.error + 2e-3
    assert facts.clipped == pytest.approx(expected.clipped, abs=0.3)


@pytest.mark.parametrize("bounds", [(-1.0, 0.0), (-1.0, -0.1)])
def test_bounds_below_light(bounds):
    """White of codes is 1 then, as for films."""
    T = transport("grey")
    codes = ltcl.Compensator(T, bounds=bounds)(np.full(GRID, 90, np.uint8))
    assert not codes.any()


def test_masked_pixels_that_count(caplog):
    """Light that is undone is not the best where weights count pixels that it cannot reach."""
    M = np.array([[0.8, 0, 0.1, 0], [0.3, 0, 0.2, 0.1], [0.1, 0, 0.7, 0.1], [0, 0, 0.1, 0.9]])
    T = ltcl.Transport(M, (2, 2))
    weights = np.array([[1.0, 10.0], [1.0, 1.0]])
    desired = np.array([[0.3, 0.5], [0.3, 0.3]])
    compensator = light(T, weights=weights, rtol=1e-4)
    compensator(desired)
    expected = ltcl.compensate(T, desired, weights=weights, rtol=1e-4)
    assert compensator.judge().error == pytest.approx(expected.error, abs=1e-3)


@pytest.mark.parametrize("order", [">u2", "<u2"])
def test_bytes_of_any_order(order):
    T = transport("grey")
    codes = rng.integers(0, 20000, GRID, dtype=np.uint16)
    expected = light(T)(codes)
    np.testing.assert_array_equal(light(T)(codes.astype(order)), expected)


def test_grey_frames_before_a_coloured_background():
    T = transport("grey")
    background = rng.uniform(0.0, 0.1, (*GRID, 3)).astype(np.float32)
    frame = rng.uniform(0.2, 0.3, GRID).astype(np.float32)
    pattern = light(T, background=background, rtol=1e-4)(frame)
    coloured = np.repeat(frame[..., None], 3, axis=-1)
    expected = ltcl.compensate(T, coloured, background=background, rtol=1e-4).pattern
    np.testing.assert_allclose(pattern, expected, rtol=0, atol=1e-3)


def test_a_cancelled_frame_spoils_nothing():
    T = transport("colour")
    frame = picture(T, 0.3)
    with light(T, clamp=True, depth=8) as compensator:
        expected = compensator(frame)
        futures = [compensator.submit(frame) for _ in range(8)]
        for future in futures:
            future.cancel()
        np.testing.assert_array_equal(compensator(frame), expected)
        assert compensator.judge().error < 0.02
    with pytest.raises(InputError, match="closed"):
        compensator.submit(frame)
    with pytest.raises(InputError, match="closed"):
        compensator(frame)


def test_another_process_makes_its_own():
    compensator = light(transport("grey"))
    for send in (pickle.dumps, copy.deepcopy):
        with pytest.raises(InputTypeError, match=r"Compensator .*pickle its T"):
            send(compensator)


@pytest.mark.parametrize(
    "out",
    [np.zeros(GRID, np.uint8), np.zeros((6, 4), np.float32), [[0.0]], np.zeros((2, *GRID), "f4")],
    ids=["type", "shape", "list", "frames"],
)
def test_places_that_do_not_fit(out):
    T = transport("grey")
    compensator = light(T)
    with pytest.raises(InputError, match="out is"):
        compensator(np.full(GRID, 0.2), out=out)
    assert compensator.statistics.frames == 0


@pytest.mark.parametrize("kind", ["grey", "masked", "mixed colours", "other camera"])
@pytest.mark.parametrize("bounds", [(0.0, 0.5), (0.1, 0.8), (-0.2, 300.0)])
def test_bounds_that_are_set(kind, bounds):
    """The next frame is as of a compensator with these bounds, whatever came before."""
    T = transport(kind)
    desired = picture(T, 2.0)
    settings: dict[str, Any] = {"rtol": 1e-3, "dtype": "uint16", "background": 0.05}
    compensator = ltcl.Compensator(T, **settings)
    futures = [compensator.submit(desired) for _ in range(3)]
    compensator.bounds = bounds
    assert compensator.bounds == bounds
    assert all(future.done() for future in futures)
    with pytest.raises(InputError, match="no frame was given yet"):
        compensator.judge()
    fresh = ltcl.Compensator(T, bounds=bounds, **settings)
    for frame in (desired, (200.0 * desired).astype(np.uint8)):
        codes = compensator(frame)
        np.testing.assert_allclose(codes, fresh(frame), rtol=0, atol=1)
        assert compensator.judge().error == pytest.approx(fresh.judge().error, abs=1e-5)
        assert compensator.judge().clipped == pytest.approx(fresh.judge().clipped, abs=1e-5)


@pytest.mark.parametrize("settings", [{"clamp": True}, {"gain": "follow"}], ids=["clamp", "follow"])
def test_bounds_that_are_set_count_everywhere(settings):
    T = transport("colour")
    compensator = light(T, rtol=1e-3, **settings)
    compensator(picture(T, 0.8))
    compensator.bounds = (0.0, 0.25)
    fresh = light(T, rtol=1e-3, bounds=(0.0, 0.25), **settings)
    fresh.gain = compensator.gain
    for seed in (2, 3):
        desired = picture(T, 0.8, seed=seed)
        if seed == 3:
            # A new one begins at the gain of its first frame.
            compensator.gain = fresh.gain
        codes = compensator(desired)
        expected = fresh(desired)
    np.testing.assert_allclose(codes, expected, rtol=0, atol=1e-6)
    assert codes.max() <= 0.25
    assert compensator.judge().clipped == pytest.approx(fresh.judge().clipped, abs=1e-6)


def test_bad_bounds_change_nothing():
    T = transport("colour")
    compensator = light(T)
    before = compensator(picture(T, 2.0))
    with pytest.raises(InputError, match="bounds is"):
        compensator.bounds = (0.5, 0.1)
    assert compensator.bounds == (0.0, 1.0)
    np.testing.assert_allclose(compensator(picture(T, 2.0)), before, rtol=0, atol=1e-3)


@pytest.mark.parametrize("settings", [{"clamp": True}, {"gain": "follow"}], ids=["clamp", "follow"])
def test_bounds_that_cannot_be_prepared_change_nothing(settings):
    """Several projectors take no bounds above 0 with these."""
    T = ltcl.combine([ltcl.Transport(dense(seed), GRID) for seed in range(2)])
    compensator = light(T, **settings)
    frame = picture(T, 0.4)
    before = compensator(frame)
    with pytest.raises(InputError, match="bounds begin above 0"):
        compensator.bounds = (0.1, 1.0)
    assert compensator.bounds == (0.0, 1.0)
    assert compensator.judge().error < 0.1
    assert compensator.statistics.frames == 1
    compensator.gain = compensator.statistics.gain
    np.testing.assert_allclose(compensator(frame), before, rtol=0, atol=1e-6)


def test_arrays_of_the_caller_may_change():
    """Frames of another kind, which are prepared later, go by what was given."""
    T = transport("grey")
    bounds: Any = np.array([0.0, 0.5])
    background = np.full(GRID, 0.05)
    weights = np.ones(GRID)
    compensator = light(T, background=background, weights=weights)
    compensator.bounds = bounds
    for values in (bounds, background, weights):
        values[1] = 0.01
    fresh = light(T, bounds=(0.0, 0.5), background=0.05, weights=np.ones(GRID))
    desired = np.repeat(picture(T, 0.6)[..., None], 3, axis=-1)
    assert compensator.bounds == (0.0, 0.5)
    np.testing.assert_allclose(compensator(desired), fresh(desired), rtol=0, atol=1e-6)


def test_light_far_beyond_the_bounds_is_refused():
    """Where squares would leave float32, also in whole numbers, and after other bounds."""
    T = transport("grey")
    compensator = light(T)
    compensator.bounds = (0.0, 1e-20)
    for frame in (picture(T, 0.4), np.full(GRID, 90, np.uint8)):
        with pytest.raises(
            InputError, match=r"with bounds of \(0.0, 1e-20\) light must be at most"
        ):
            compensator(frame)
    compensator(picture(T, 1e-19))
    assert 0.5 < compensator.judge().error < 1.0
    with pytest.raises(InputError, match="as bounds allow it"):
        compensator.bounds = (0.0, 1e-35)


@pytest.mark.parametrize("gain", [0.0, -1.0, np.nan, 1e30, "a", None])
def test_a_gain_that_is_set(gain):
    compensator = light(transport("grey"))
    with pytest.raises((InputError, InputTypeError), match="gain"):
        compensator.gain = gain
    assert compensator.gain == 1.0


FILMS: dict[str, tuple[Any, str]] = {
    "none": ([], "film has no frames"),
    "number": (3, "film is 3"),
    "file": ("film.mp4", r"film is 'film\.mp4'; it must be frames"),
    "one picture": (np.zeros(GRID), "film, frame 1: frame has shape"),
    "sizes": ([np.ones(GRID), np.ones((2, 2))], "film, frame 2"),
    "NaN": ([np.full(GRID, np.nan)], "film, frame 1"),
}


@pytest.mark.parametrize("case", FILMS)
def test_bad_films(case):
    film, message = FILMS[case]
    with pytest.raises((InputError, InputTypeError), match=message):
        light(transport("grey"), gain="auto", film=film)


def test_film_grey_and_coloured():
    T = transport("grey")
    film = [np.full(GRID, 0.3), np.full((*GRID, 3), 0.2)]
    assert light(T, gain="auto", film=film).gain > 1.0


class Curve:
    """A response by any function."""

    def __init__(self, linear):
        self.linear = linear


@pytest.mark.parametrize(
    "linear",
    [np.ones_like, lambda codes: 1.0 - codes, lambda codes: codes * np.nan, lambda codes: 1.0],
    ids=["constant", "falling", "NaN", "a number"],
)
def test_bad_responses(linear):
    with pytest.raises(InputError, match="encode is a response"):
        light(transport("grey"), encode=Curve(linear))


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "decode": ({"decode": "gamma"}, "decode is 'gamma'"),
    "encode": ({"encode": "gamma"}, "encode is 'gamma'"),
    "encode object": ({"encode": 3.0}, "encode is a float"),
    "response": ({"encode": Response(np.ones((3, 1)) * [0.0, 1.0])}, "response of 3 channels"),
    "dtype": ({"dtype": "int8"}, "dtype is 'int8'"),
    "dtypes": ({"dtype": ["uint8"]}, "dtype is"),
    "gains": ({"gain": np.array([1.0, 2.0])}, "gain"),
    "film of follow": ({"gain": "follow", "film": [np.zeros(GRID)]}, "gain is 'follow'"),
    "gain": ({"gain": "loud"}, "gain is 'loud'"),
    "gain below 0": ({"gain": -1.0}, "gain"),
    "no film": ({"gain": "auto"}, "film is None"),
    "film": ({"film": [np.zeros(GRID)]}, "film is given"),
    "deadline": ({"deadline_ms": 0.0}, "deadline_ms"),
    "depth": ({"depth": 0}, "depth"),
    "bounces": ({"bounces_every": 0}, "bounces_every is 0; it must be a whole number"),
    "bounces of halves": ({"bounces_every": 1.5}, r"bounces_every is 1\.5"),
    "late": ({"late": "never"}, "late is 'never'"),
    "change": ({"gain_change": 0.5}, "gain_change"),
    "fps": ({"fps": 0.0}, "fps"),
    "bounds": ({"bounds": (1.0, 0.0)}, "bounds"),
    "weights": ({"weights": -np.ones(GRID)}, "weights"),
    "rtol": ({"rtol": 2.0}, "rtol"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_arguments(case):
    arguments, message = BAD[case]
    with pytest.raises((InputError, InputTypeError), match=message):
        ltcl.Compensator(transport("grey"), **arguments)


def test_bad_frames():
    T = transport("grey")
    compensator = ltcl.Compensator(T)
    with pytest.raises(InputError, match="no frame was given"):
        compensator.judge()
    with pytest.raises(InputError, match=r"frame has shape \(2, 2\)"):
        compensator(np.zeros((2, 2), np.uint8))
    with pytest.raises(InputTypeError, match="frame holds int64"):
        compensator(np.zeros(GRID, np.int64))
    with pytest.raises(InputError, match="frame"):
        compensator(np.full(GRID, np.nan))
    with pytest.raises(InputError, match="whole numbers"):
        ltcl.Compensator(T, decode="srgb")(T.device.upload(np.zeros(GRID)))
    for value in (None, "abc"):
        with pytest.raises(InputTypeError, match="frame is"):
            compensator(value)
    with pytest.raises(InputError, match="frame reaches 1e"):
        compensator(np.full(GRID, 1e30))
    with pytest.raises(InputTypeError, match="on the device"):
        compensator(T.device.upload(np.zeros(GRID), np.float64))
    with pytest.raises(InputTypeError, match="T is a"):
        ltcl.Compensator(np.eye(3))  # pyright: ignore[reportArgumentType]


def test_gain_follows_only_undone_light():
    with pytest.raises(InputError, match="no S"):
        ltcl.Compensator(transport("blocks"), gain="follow")


def test_clamp_needs_light_that_is_undone():
    """A T whose light no fixed number of steps undoes is solved within the bounds only."""
    grid = (24, 26)
    n = 24 * 26
    T = 0.5 * np.eye(n)
    T[0, 1] = T[1, 0] = 50.0
    strong = ltcl.Transport(T, grid)
    with pytest.raises(InputError, match="clamp is True"):
        light(strong, clamp=True)
    with pytest.raises(InputError, match="gain is 'follow'"):
        light(strong, gain="follow")
    with pytest.raises(InputError, match="bounces_every is 2, but 60 steps"):
        light(strong, bounces_every=2)
    desired = strong @ np.full(grid, 0.5)
    compensator = light(strong, rtol=1e-3)
    compensator(desired)
    assert compensator.judge().error < 2e-3


def test_singular_light_is_found_within_the_bounds():
    """A small T with two equal columns, whose light has no inverse."""
    T = dense(0)
    T[:, 1] = T[:, 0]
    T[1] = T[0]
    singular = ltcl.Transport(T, GRID)
    desired = singular @ np.full(GRID, 0.5)
    compensator = light(singular, rtol=1e-3)
    compensator(desired)
    assert compensator.judge().error < 2e-3


def test_table_of_one_channel_for_three():
    with pytest.raises(InputError, match="3 channels"):
        code_table(Response(np.ones((3, 1)) * [0.0, 1.0]), "uint8", 1, 1.0)
