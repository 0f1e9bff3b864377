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
    mi.set_variant("scalar_rgb")
    place = mi.ScalarTransform4f
    there = place().look_at(origin=[0, 0, DISTANCE], target=[0, 0, 0], up=[0, 1, 0])
    pinhole = {"fov": FOV, "fov_axis": "x", "to_world": there}
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ALBEDO] * 3}}
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "wall": {"type": "rectangle", "to_world": place().scale([3, 3, 3]), "bsdf": diffuse},
        "sensor": {"type": "perspective", "film": film, **pinhole},
        "projector": {"type": "projector", **pinhole},
        **more,
    }


def patterns(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random((count, *GRID, 3)).astype(np.float32)


def on_the_wall(light: np.ndarray) -> np.ndarray:
    """Radiance: in Mitsuba's unit a white wall at distance 1 has that of the pattern."""
    return ALBEDO * light / DISTANCE**2


def rig(scene: Any = None, **change: Any) -> MitsubaRig:
    return MitsubaRig(wall() if scene is None else scene, GRID, **{"camera_grid": GRID, **LINEAR, **change})


def test_a_wall_shows_the_pattern_pixel_by_pixel(tmp_path: Path) -> None:
    (tmp_path / "wall.xml").write_text(XML)
    codes, other = patterns(2)
    for scene in (wall(), tmp_path / "wall.xml"):
        np.testing.assert_allclose(rig(scene).radiance(codes), on_the_wall(codes), rtol=1e-4)
    assert rig(tmp_path / "wall.xml").describe()["scene"] == "wall.xml"
    seen, green = rig(), rig(channels=1)
    np.testing.assert_allclose(
        seen.radiance((codes + other) / 2), on_the_wall((codes + other) / 2), rtol=1e-4
    )
    np.testing.assert_array_equal(green.radiance(codes[..., 0]), seen.radiance(codes[..., 0])[..., 1])


def test_photographs_follow_projector_and_sensor() -> None:
    response = ["linear", np.sqrt, "gamma2.2"]
    options = {"projector_response": response, "projector_black": 0.1, "response": "srgb", "sensitivity": 2.0}
    codes, seconds = patterns(1)[0].astype(np.float64), 0.75
    light = 0.1 + 0.9 * np.stack([codes[..., 0], np.sqrt(codes[..., 1]), codes[..., 2] ** 2.2], axis=-1)
    expected = 0.03 + 0.97 * to_srgb(np.minimum(2.0 * seconds * on_the_wall(light), 1.0))
    image = rig(**{**CLEAN, "black": 0.03, **options}).photograph(codes, seconds)
    np.testing.assert_allclose(image, expected, rtol=1e-4)
    half = rig(**{**CLEAN, "sensitivity": None}).photograph(np.ones(GRID), 1.0)
    np.testing.assert_allclose(half, 0.5, rtol=1e-3)


def test_other_emitters_are_ambient_light() -> None:
    lamp = {"type": "constant", "radiance": {"type": "rgb", "value": [0.3] * 3}}
    lit, codes = rig(wall(lamp=lamp), samples=256), patterns(1)[0]
    ambient = lit.radiance(np.zeros(GRID))
    np.testing.assert_allclose(ambient, ALBEDO * 0.3, rtol=0.3)
    np.testing.assert_allclose((lit.radiance(codes) - ambient).mean(), on_the_wall(codes).mean(), rtol=0.1)


def test_one_bounce_is_that_of_quadrature() -> None:
    """White light on the left wall of a right angle; the right wall shows its first bounce."""
    n, albedo = 8, 0.6
    scene = mitsuba_scene("dihedral", (n, n), albedo, depth=3)
    corner = MitsubaRig(scene, (n, n), channels=1, **{**LINEAR, "samples": 16384})
    codes = np.zeros((n, n))
    codes[:, : n // 2] = 1.0
    tangent = math.tan(math.radians(scene["projector"]["fov"] / 2))
    eye = np.array([0.0, 0.0, 3.0])

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
    k = 3.0 / (1 + tx)  # the right wall is x = z
    seen = np.stack([k * tx, k * ty, 3.0 - k], axis=-1)[:, n * 2 :].reshape(-1, 3)
    facing = np.array([-1.0, 0.0, 1.0]) / math.sqrt(2)
    bounced = np.empty(len(seen))
    for number, point in enumerate(seen):
        to = left - point
        r2 = np.sum(to**2, axis=1)
        form = np.maximum(to @ facing, 0) * np.maximum(-to @ normal, 0) / r2**2
        bounced[number] = albedo / math.pi * area * (L @ form)
    expected = bounced.reshape(n, 4, n // 2, 4).mean(axis=(1, 3))

    image = corner.radiance(codes)
    assert image[:, : n // 2].sum() > 10 * image[:, n // 2 :].sum()  # left is left
    inner = (slice(2, 6), slice(1, 3))  # away from the seam, where quadrature is poor, and from edges
    np.testing.assert_allclose(image[:, n // 2 :][inner], expected[inner], rtol=0.08)
    assert image[:, n // 2 :][inner].mean() == pytest.approx(expected[inner].mean(), rel=0.02)


@pytest.mark.parametrize(("name", "walls"), [("dihedral", 2), ("trihedral", 3), ("box", 5)])
def test_all_walls_of_a_scene_are_lit_and_seen(name: str, walls: int) -> None:
    colours = np.eye(walls, 3) * 0.5 + 0.1 if walls <= 3 else np.full((walls, 3), 0.6)
    grid = (24, 32)
    image = MitsubaRig(mitsuba_scene(name, grid, colours, depth=2), grid, **LINEAR).radiance(np.ones(grid))
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    lit = image.max(axis=-1) > 0
    assert 0.3 < lit.mean() < 1  # walls fill the frame, with black around
    assert (border.max(axis=-1) == 0).any()
    if walls <= 3:
        assert set(image.argmax(axis=-1)[lit].tolist()) == set(range(walls))
    if name == "dihedral":
        assert image[12, 10].argmax() == 0  # the first wall, red, is the left one
        scene = mitsuba_scene(name, grid, colours, baseline=1.0, depth=2)
        right = MitsubaRig(scene, grid, **LINEAR).radiance(np.ones(grid))
        red = [np.mean(view.argmax(axis=-1)[view.max(axis=-1) > 0] == 0) for view in (image, right)]
        assert red[1] > red[0] + 0.03  # a camera to the right sees more of the left wall


def away() -> dict[str, Any]:
    return wall(sensor={"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}})


@pytest.mark.parametrize(
    ("scene", "error", "message"),
    [
        (42, InputTypeError, "scene is a int"),
        ("nowhere.xml", FileError, r"nowhere\.xml: no such file"),
        ({"type": "scene", "a": {"type": "projector"}, "b": {"type": "nonsense"}}, InputError, "nonsense"),
        ({"type": "scene"}, InputError, "scene has 0 projectors"),
        ({"type": "projector"}, InputError, "scene is no scene with one sensor"),
        (lambda: wall(other={"type": "projector"}), InputError, "scene has 2 projectors"),
        (away, InputError, "scene shows no light of its projector"),
    ],
)
def test_scenes_that_cannot_be_used_are_named(scene: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as raised:
        MitsubaRig(scene() if callable(scene) else scene, GRID, **FAST)
    assert "\n" not in str(raised.value)


def test_it_is_a_rig_that_leaves_the_variant_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    mi.set_variant("scalar_spectral")
    shots = Shots(MitsubaRig("trihedral", GRID, camera_grid=(5, 7), bits=12, **FAST))
    image = shots.photograph(np.ones(GRID), 1.0)
    assert (image.shape, shots.levels, shots.camera_grid) == ((5, 7, 3), 4096, (5, 7))
    assert mi.variant() == "scalar_spectral"
    facts = json.loads(json.dumps(shots.describe()))["rig"]
    assert (facts["kind"], facts["scene"], facts["variant"]) == ("mitsuba", "trihedral", "scalar_rgb")
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(AcquisitionError, match=r"mitsuba.*ltcl\[rig\]"):
        MitsubaRig("box", GRID)


@pytest.mark.parametrize(
    ("call", "change", "message"),
    [
        *(
            (MitsubaRig, change, message)
            for change, message in (
                ({"projector_grid": (0, 2)}, "projector_grid is"),
                ({"camera_grid": (2,)}, "camera_grid is"),
                ({"channels": 2}, "channels is 2"),
                ({"samples": 0}, "samples is 0"),
                ({"sensitivity": 0.0}, r"sensitivity is 0\.0"),
                ({"bits": 7}, "bits is 7"),
                ({"variant": "scalar_mono"}, "variant is 'scalar_mono'; .*scalar_rgb"),
            )
        ),
        (mitsuba_scene, {"name": "cube"}, "name is 'cube'; .* dihedral, trihedral, box"),
        (mitsuba_scene, {"grid": 4}, "grid is 4"),
        (mitsuba_scene, {"albedo": 1.0}, "albedo reaches from 1 to 1"),
        (mitsuba_scene, {"albedo": [0.1, 0.2]}, r"albedo has shape \(2,\)"),
        (mitsuba_scene, {"baseline": 9.0}, r"baseline is 9\.0"),
        (mitsuba_scene, {"depth": 1}, "depth is 1"),
    ],
)
def test_bad_arguments_are_named(call: Any, change: dict[str, Any], message: str) -> None:
    good = (
        {"scene": "box", "projector_grid": GRID, **FAST}
        if call is MitsubaRig
        else {"name": "box", "grid": GRID}
    )
    with pytest.raises(LtclError, match=message):
        call(**{**good, **change})
