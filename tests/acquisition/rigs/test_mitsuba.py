# SPDX-License-Identifier: BSD-3-Clause
"""`MitsubaRig` against closed forms and quadrature: what the projector casts and what one bounce of it is."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import MitsubaRig, Shots, mitsuba_scene
from ltcl.acquisition.rigs import mitsuba_loading
from ltcl.acquisition.rigs.mitsuba_scenes import EYE, within
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.images import to_srgb

mi = pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')

GRID = (4, 6)
FAST: dict[str, Any] = {"variant": "scalar_rgb", "samples": 16}
CLEAN: dict[str, Any] = {"gain": None, "read": 0.0, "black": 0.0, "bits": "float", "response": "linear"}
LINEAR: dict[str, Any] = {**FAST, "projector_response": "linear", "sensitivity": 1.0}
ALBEDO, DISTANCE, FOV = 0.5, 2.0, 60.0
XML = """<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <shape type="rectangle"><transform name="to_world"><scale value="3"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
    <sensor type="perspective"><float name="fov" value="60"/><string name="fov_axis" value="x"/>
        <transform name="to_world"><lookat origin="0, 0, 2" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><rfilter type="box"/></film></sensor>
    <emitter type="projector"><float name="fov" value="60"/><string name="fov_axis" value="x"/>
        <transform name="to_world"><lookat origin="0, 0, 2" target="0, 0, 0" up="0, 1, 0"/></transform>
    </emitter>
</scene>
"""


def wall(**more: Any) -> dict[str, Any]:
    """A diffuse wall that faces projector and camera, both in one place."""
    with within(mi, "scalar_rgb"):
        place = mi.ScalarTransform4f
        there = place().look_at(origin=[0, 0, DISTANCE], target=[0, 0, 0], up=[0, 1, 0])
        pinhole = {"fov": FOV, "fov_axis": "x", "to_world": there}
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ALBEDO] * 3}}
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 4},
            "wall": {"type": "rectangle", "to_world": place().scale([3, 3, 3]), "bsdf": diffuse},
            "sensor": {
                "type": "perspective",
                "film": {"type": "hdrfilm", "rfilter": {"type": "box"}},
                **pinhole,
            },
            "projector": {"type": "projector", **pinhole},
            **more,
        }


def patterns(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random((count, *GRID, 3)).astype(np.float32)


def on_the_wall(light: np.ndarray) -> np.ndarray:
    """Radiance: in Mitsuba's unit a white wall at distance 1 has that of the pattern."""
    return ALBEDO * light / DISTANCE**2


def test_a_wall_shows_the_pattern_pixel_by_pixel() -> None:
    rig = MitsubaRig(wall(), GRID, camera_grid=GRID, **LINEAR)
    for codes in patterns(2):
        np.testing.assert_allclose(rig.radiance(codes), on_the_wall(codes), rtol=1e-4)
    grey = patterns(1)[0, ..., 0]
    np.testing.assert_allclose(rig.radiance(grey), on_the_wall(np.repeat(grey[..., None], 3, -1)), rtol=1e-4)


def test_codes_pass_the_projector_s_response_and_black() -> None:
    response = ["linear", np.sqrt, "gamma2.2"]
    options = {**LINEAR, "projector_response": response, "projector_black": 0.1}
    rig = MitsubaRig(wall(), GRID, camera_grid=GRID, **options)
    codes = patterns(1)[0].astype(np.float64)
    light = np.stack([codes[..., 0], np.sqrt(codes[..., 1]), codes[..., 2] ** 2.2], axis=-1)
    np.testing.assert_allclose(rig.radiance(codes), on_the_wall(0.1 + 0.9 * light), rtol=1e-4)


def test_photographs_follow_the_sensor() -> None:
    options = {**LINEAR, **CLEAN, "black": 0.03, "response": "srgb", "sensitivity": 2.0}
    rig = MitsubaRig(wall(), GRID, camera_grid=GRID, **options)
    codes, seconds = patterns(1)[0], 0.75
    value = 2.0 * seconds * on_the_wall(codes.astype(np.float64))
    expected = 0.03 + 0.97 * to_srgb(np.minimum(value, 1.0))
    np.testing.assert_allclose(rig.photograph(codes, seconds), expected, rtol=1e-4)


def test_light_adds_up_without_noise() -> None:
    rig = MitsubaRig("dihedral", GRID, **LINEAR)
    a, b = patterns(2) / 2
    A, B, both = rig.radiance(a), rig.radiance(b), rig.radiance(a + b)
    np.testing.assert_allclose(A + B, both, rtol=1e-5, atol=1e-6 * both.max())


def test_one_bounce_is_that_of_quadrature() -> None:
    """White light on the left wall of a right angle; the right wall shows its first bounce."""
    n, albedo = 8, 0.6
    scene = mitsuba_scene("dihedral", (n, n), albedo, depth=3)
    rig = MitsubaRig(scene, (n, n), channels=1, **{**LINEAR, "samples": 16384})
    codes = np.zeros((n, n))
    codes[:, : n // 2] = 1.0
    tangent = math.tan(math.radians(scene["projector"]["fov"] / 2))
    eye = np.array([0.0, 0.0, EYE])

    s = (np.arange(80) + 0.5) / 80 * math.sqrt(0.5)  # the left wall is x = -z
    x, y = np.meshgrid(-s, s * math.sqrt(2) - 0.5)
    left = np.stack([x, y, -x], axis=-1).reshape(-1, 3)
    area, normal = 1.0 / 80**2, np.array([1.0, 0.0, 1.0]) / math.sqrt(2)
    away = left - eye
    far = np.linalg.norm(away, axis=1)
    cos_eye = -away[:, 2] / far
    # A plane across the axis at distance 1 gets the irradiance pi everywhere.
    irradiance = math.pi / cos_eye**3 * (-away @ normal / far) / far**2
    L = albedo / math.pi * irradiance

    across = (2 * (np.arange(n * 4) + 0.5) / (n * 4) - 1) * tangent  # 4 x 4 rays in each pixel
    tx, ty = np.meshgrid(across, -across)
    k = EYE / (1 + tx)  # the right wall is x = z
    seen = np.stack([k * tx, k * ty, EYE - k], axis=-1)[:, n * 2 :].reshape(-1, 3)
    facing = np.array([-1.0, 0.0, 1.0]) / math.sqrt(2)
    bounced = np.empty(len(seen))
    for number, point in enumerate(seen):
        to = left - point
        r2 = np.sum(to**2, axis=1)
        form = np.maximum(to @ facing, 0) * np.maximum(-to @ normal, 0) / r2**2
        bounced[number] = albedo / math.pi * area * (L @ form)
    wanted = bounced.reshape(n, 4, n // 2, 4).mean(axis=(1, 3))

    image = rig.radiance(codes)
    assert image[:, : n // 2].sum() > 10 * image[:, n // 2 :].sum()  # left is left
    inner = (slice(2, 6), slice(1, 3))  # away from the seam, where quadrature is poor, and from edges
    np.testing.assert_allclose(image[:, n // 2 :][inner], wanted[inner], rtol=0.08)
    assert image[:, n // 2 :][inner].mean() == pytest.approx(wanted[inner].mean(), rel=0.02)


@pytest.mark.parametrize(("name", "walls"), [("dihedral", 2), ("trihedral", 3), ("box", 5)])
def test_all_walls_of_a_scene_are_lit_and_seen(name: str, walls: int) -> None:
    colours = np.eye(walls, 3) * 0.5 + 0.1 if walls <= 3 else np.full((walls, 3), 0.6)
    grid = (24, 32)
    rig = MitsubaRig(mitsuba_scene(name, grid, colours, depth=2), grid, **LINEAR)
    image = rig.radiance(np.ones(grid))
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    lit = image.max(axis=-1) > 0
    assert 0.3 < lit.mean() < 1  # walls fill the frame, with black around
    assert (border.max(axis=-1) == 0).any()
    if walls <= 3:
        brightest = image.argmax(axis=-1)[lit]
        assert {int(c) for c in np.unique(brightest)} == set(range(walls))
    if name == "dihedral":
        middle = image[12]
        assert middle[10].argmax() == 0  # the first wall, red, is the left one
        assert middle[22].argmax() == 1


def test_more_edges_add_light_and_a_camera_to_the_right_sees_more_of_the_left_wall() -> None:
    grid = (16, 24)
    direct, all_light = (
        MitsubaRig(mitsuba_scene("dihedral", grid, depth=d), grid, **LINEAR).radiance(np.ones(grid)).mean()
        for d in (2, 16)
    )
    assert all_light > 1.05 * direct
    reds = [[0.8, 0.1, 0.1], [0.1, 0.8, 0.1]]
    shares = []
    for baseline in (0.0, 1.0):
        scene = mitsuba_scene("dihedral", grid, reds, baseline=baseline, depth=2)
        seen = MitsubaRig(scene, grid, **LINEAR).radiance(np.ones(grid))
        shares.append(float(np.mean(seen.argmax(axis=-1)[seen.max(axis=-1) > 0] == 0)))
    assert shares[1] > shares[0] + 0.03


def test_one_channel_is_the_green_one() -> None:
    scene = mitsuba_scene("box", GRID, [0.2, 0.4, 0.6])
    grey = MitsubaRig(scene, GRID, channels=1, **LINEAR)
    colour = MitsubaRig(scene, GRID, channels=3, **LINEAR)
    codes = patterns(1)[0, ..., 0]
    np.testing.assert_array_equal(grey.radiance(codes), colour.radiance(codes)[..., 1])
    assert grey.photograph(codes, 1.0).shape == GRID


def test_noise_depends_on_what_is_asked_for_alone() -> None:
    a, b = patterns(2)
    first, second, other = (MitsubaRig("dihedral", GRID, **{**LINEAR, "seed": seed}) for seed in (3, 3, 4))
    wanted = [first.photograph(a, 1.0), first.photograph(a, 1.0), first.photograph(b, 1.0)]
    assert np.any(wanted[0] != wanted[1])
    second.photograph(b, 0.5)
    np.testing.assert_array_equal(second.photograph(b, 1.0), wanted[2])
    np.testing.assert_array_equal(second.photograph(a, 1.0), wanted[0])
    np.testing.assert_array_equal(second.photograph(a, 1.0), wanted[1])
    assert np.any(other.photograph(a, 1.0) != wanted[0])


def test_white_light_fills_half_a_pixel_in_a_second_unless_told() -> None:
    rig = MitsubaRig(wall(), GRID, camera_grid=(8, 12), **FAST, **CLEAN)
    np.testing.assert_allclose(rig.photograph(np.ones(GRID), 1.0), 0.5, rtol=1e-3)


def test_a_file_is_the_scene_that_it_describes(tmp_path: Path) -> None:
    path = tmp_path / "wall.xml"
    path.write_text(XML)
    rig = MitsubaRig(path, GRID, camera_grid=GRID, **LINEAR)
    codes = patterns(1)[0]
    np.testing.assert_allclose(rig.radiance(codes), on_the_wall(codes), rtol=1e-4)
    assert rig.describe()["scene"] == "wall.xml"


def test_other_emitters_are_ambient_light() -> None:
    lamp = {"type": "constant", "radiance": {"type": "rgb", "value": [0.3] * 3}}
    rig = MitsubaRig(wall(lamp=lamp), GRID, camera_grid=GRID, **{**LINEAR, "samples": 256})
    codes = patterns(1)[0]
    ambient = rig.radiance(np.zeros(GRID))
    np.testing.assert_allclose(ambient, ALBEDO * 0.3, rtol=0.3)
    np.testing.assert_allclose((rig.radiance(codes) - ambient).mean(), on_the_wall(codes).mean(), rtol=0.1)


def test_a_variant_that_somebody_set_stays() -> None:
    with within(mi, "scalar_spectral"):
        rig = MitsubaRig(wall(), GRID, camera_grid=GRID, **LINEAR)
        assert rig.radiance(np.ones(GRID)).shape == (*GRID, 3)
        assert mi.variant() == "scalar_spectral"


def test_the_fastest_variant_that_works_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for works, name in [(True, "llvm_ad_rgb"), (False, "scalar_rgb")]:
        monkeypatch.setattr(mitsuba_loading, "_renders", lambda variant, works=works: works)
        assert mitsuba_loading.variant_of(mi, "auto") == name
    with pytest.raises(InputError, match="variant is 'scalar_mono'; it must be one of auto, scalar_rgb"):
        mitsuba_loading.variant_of(mi, "scalar_mono")


def test_a_trial_tells_what_works_from_what_does_not() -> None:
    assert mitsuba_loading._renders("scalar_rgb")
    assert not mitsuba_loading._renders("scalar_nonsense")


def test_it_is_a_rig_and_tells_plain_json() -> None:
    shots = Shots(MitsubaRig("trihedral", GRID, camera_grid=(5, 7), bits=12, **FAST))
    image = shots.photograph(np.ones(GRID), 1.0)
    assert (image.shape, shots.levels, shots.camera_grid) == ((5, 7, 3), 4096, (5, 7))
    told = json.loads(json.dumps(shots.describe()))["rig"]
    assert (told["kind"], told["scene"], told["variant"]) == ("mitsuba", "trihedral", "scalar_rgb")


@pytest.mark.parametrize(
    ("scene", "error", "message"),
    [
        (42, InputTypeError, "scene is a int; it must be one of dihedral"),
        ("nowhere.xml", FileError, r"nowhere\.xml: no such file"),
        (
            {"type": "scene", "a": {"type": "projector"}, "b": {"type": "nonsense"}},
            InputError,
            "cannot be loaded by Mitsuba: .*nonsense",
        ),
        ({"type": "scene"}, InputError, "scene has 0 projectors"),
        ({"type": "projector"}, InputError, "scene is no scene with one sensor"),
    ],
)
def test_scenes_that_cannot_be_used_are_named(scene: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as raised:
        MitsubaRig(scene, GRID, **FAST)
    assert "\n" not in str(raised.value)


def test_a_second_projector_and_a_camera_that_looks_away_are_refused() -> None:
    with pytest.raises(InputError, match="scene has 2 projectors"):
        MitsubaRig(wall(other={"type": "projector"}), GRID, **FAST)
    scene = wall(sensor={"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}})
    with pytest.raises(InputError, match="scene shows no light of its projector"):
        MitsubaRig(scene, GRID, **FAST)


def test_a_broken_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "broken.xml"
    path.write_text(XML[:200])
    with pytest.raises(InputError, match="scene cannot be loaded by Mitsuba: ") as raised:
        MitsubaRig(path, GRID, **FAST)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"projector_grid": (0, 2)}, "projector_grid is"),
        ({"camera_grid": (2,)}, "camera_grid is"),
        ({"channels": 2}, "channels is 2"),
        ({"samples": 0}, "samples is 0"),
        ({"sensitivity": 0.0}, r"sensitivity is 0\.0"),
        ({"bits": 7}, "bits is 7"),
        ({"seed": -1}, "seed is -1"),
        ({"projector_black": 1.0}, r"projector_black is 1\.0"),
        ({"response": "film2"}, "response is 'film2'"),
    ],
)
def test_bad_arguments_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(LtclError, match=message):
        MitsubaRig(**{"scene": "box", "projector_grid": GRID, **FAST, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "cube"}, "name is 'cube'; it must be one of dihedral, trihedral, box"),
        ({"grid": 4}, "grid is 4"),
        ({"albedo": 1.0}, "albedo reaches from 1 to 1"),
        ({"albedo": [0.1, 0.2]}, r"albedo has shape \(2,\)"),
        ({"albedo": math.nan}, "albedo has 1 NaN"),
        ({"baseline": 9.0}, r"baseline is 9\.0"),
        ({"depth": 1}, "depth is 1"),
    ],
)
def test_bad_scene_arguments_are_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(LtclError, match=message):
        mitsuba_scene(**{"name": "box", "grid": GRID, **change})


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(AcquisitionError, match=r'MitsubaRig needs mitsuba.*pip install "ltcl\[rig\]"'):
        MitsubaRig("box", GRID)
