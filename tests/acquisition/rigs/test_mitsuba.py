# SPDX-License-Identifier: BSD-3-Clause
"""`MitsubaRig` against closed forms and quadrature: light of the projector and one bounce."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import MitsubaRig, Shots
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError
from ltcl.images import from_srgb

mi = pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')

random = np.random.default_rng(0)
GRID = (4, 6)
FAST: dict[str, Any] = {"samples": 16}
CLEAN: dict[str, Any] = {
    "gain": None,
    "read": 0.0,
    "black": 0.0,
    "bits": "float",
    "response": "linear",
}
LINEAR: dict[str, Any] = {**FAST, "projector_response": "linear", "sensitivity": 1.0}
ALBEDO = 0.5
DISTANCE = 2.0


def wall(**more: Any) -> dict[str, Any]:
    """A diffuse wall that faces projector and camera, both in one place."""
    mi.set_variant("scalar_rgb")
    there = mi.ScalarTransform4f().look_at(origin=[0, 0, DISTANCE], target=[0, 0, 0], up=[0, 1, 0])
    pinhole = {"fov": 60.0, "fov_axis": "x", "to_world": there}
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ALBEDO] * 3}}
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}}
    wide = mi.ScalarTransform4f().scale([3, 3, 3])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "wall": {"type": "rectangle", "to_world": wide, "bsdf": diffuse},
        "sensor": {"type": "perspective", "film": film, **pinhole},
        "projector": {"type": "projector", **pinhole},
        **more,
    }


def on_the_wall(light: np.ndarray) -> np.ndarray:
    """Radiance: in Mitsuba's unit a white wall at distance 1 has that of the pattern."""
    return ALBEDO * light / DISTANCE**2


def rig(scene: Any = None, **change: Any) -> MitsubaRig:
    return MitsubaRig(
        wall() if scene is None else scene, GRID, **{"camera_grid": GRID, **LINEAR, **change}
    )


def test_a_wall_shows_the_pattern_pixel_by_pixel(tmp_path: Path) -> None:
    codes = random.random((*GRID, 3)).astype(np.float32)
    described = wall()
    parsed = mi.parser.parse_dict(mi.parser.ParserConfig("scalar_rgb"), described)
    mi.parser.write_file(parsed, str(tmp_path / "wall.xml"))
    for scene in (described, tmp_path / "wall.xml"):
        np.testing.assert_allclose(rig(scene).radiance(codes), on_the_wall(codes), rtol=1e-4)
    green = rig(channels=1).radiance(codes[..., 0])
    np.testing.assert_array_equal(green, rig().radiance(codes[..., 0])[..., 1])


def test_white_is_at_half_of_the_range() -> None:
    half = rig(**{**CLEAN, "sensitivity": None}).photograph(np.ones(GRID), 1.0)
    np.testing.assert_allclose(half, 0.5, rtol=1e-3)
    codes = random.random((*GRID, 3))
    curves = rig(**{**CLEAN, "projector_response": "srgb", "projector_black": 0.1}).radiance(codes)
    np.testing.assert_allclose(curves, on_the_wall(0.1 + 0.9 * from_srgb(codes)), rtol=1e-4)


@pytest.mark.slow
def test_one_bounce_is_that_of_quadrature() -> None:
    """White light is on the left wall, x = -z; the right wall shows its first bounce."""
    n = 8
    albedo = 0.6
    options: dict[str, Any] = {
        "albedo": albedo,
        "depth": 3,
        "channels": 1,
        **LINEAR,
        "samples": 16384,
    }
    codes = np.zeros((n, n))
    codes[:, : n // 2] = 1.0
    image = MitsubaRig("dihedral", (n, n), **options).radiance(codes)

    s = (np.arange(80) + 0.5) / 80 * np.sqrt(0.5)
    x, y = np.meshgrid(-s, s * np.sqrt(2) - 0.5)
    left = np.stack([x, y, -x], axis=-1).reshape(-1, 3)
    normal = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    facing = np.array([-1.0, 0.0, 1.0]) / np.sqrt(2)
    away = left - [0.0, 0.0, 3.0]
    far = np.linalg.norm(away, axis=1)
    # A plane across the axis at distance 1 gets the irradiance pi everywhere.
    L = albedo * (-far / away[:, 2]) ** 3 * (-away @ normal / far) / far**2
    # Half the frame, around the outer edges.
    tangent = 1.02 * np.sqrt(0.5) / (3.0 - np.sqrt(0.5))
    across = (2 * (np.arange(n * 4) + 0.5) / (n * 4) - 1) * tangent  # 4 x 4 rays in each pixel
    tx, ty = np.meshgrid(across, -across)
    k = 3.0 / (1 + tx)  # where they meet the right wall, x = z
    right = np.stack([k * tx, k * ty, 3.0 - k], axis=-1)[:, n * 2 :].reshape(-1, 1, 3)
    to = left - right
    form = np.maximum(to @ facing, 0) * np.maximum(-to @ normal, 0) / np.sum(to**2, axis=2) ** 2
    bounced = albedo / np.pi / 80**2 * (form @ L)
    expected = bounced.reshape(n, 4, n // 2, 4).mean(axis=(1, 3))

    assert image[:, : n // 2].sum() > 10 * image[:, n // 2 :].sum()  # left is left
    # Away from the seam, where quadrature is poor, and from edges.
    inner = np.s_[2:6, 1:3]
    np.testing.assert_allclose(image[:, n // 2 :][inner], expected[inner], rtol=0.08)
    assert image[:, n // 2 :][inner].mean() == pytest.approx(expected[inner].mean(), rel=0.02)


@pytest.mark.parametrize(("name", "walls"), [("dihedral", 2), ("trihedral", 3), ("box", 5)])
def test_all_walls_of_a_scene_are_lit_and_seen(name: str, walls: int) -> None:
    colours = np.arange(3 * walls).reshape(walls, 3) % 5 / 5 + 0.1  # no two walls have the same hue
    grid = (24, 32)
    options = {"albedo": colours, "depth": 2, **LINEAR}
    views = []
    for x in (0.0, 1.0):
        view = MitsubaRig(name, grid, baseline=x, **options).radiance(np.ones(grid))
        views.append(view)
    lit = views[0].max(axis=-1) > 0
    hues = colours / np.linalg.norm(colours, axis=1, keepdims=True)
    assert 0.3 < lit.mean() < 1  # walls fill the frame, with black around
    nearest = [np.argmax(view[view.max(axis=-1) > 0] @ hues.T, axis=1) for view in views]
    assert set(nearest[0]) == set(range(walls))
    if name == "dihedral":  # a camera to the right sees more of the left wall
        assert np.mean(nearest[1] == 0) > np.mean(nearest[0] == 0) + 0.03


def test_it_is_a_rig_that_leaves_the_variant_of_others(monkeypatch: pytest.MonkeyPatch) -> None:
    mi.set_variant("scalar_spectral")
    shots = Shots(MitsubaRig("trihedral", GRID, camera_grid=(5, 7), bits=12, **FAST))
    image = shots.photograph(np.ones(GRID), 1.0)
    assert (image.shape, shots.levels, shots.camera_grid) == ((5, 7, 3), 4096, (5, 7))
    assert mi.variant() == "scalar_spectral"
    facts = shots.describe()["rig"]
    assert facts["kind"] == "mitsuba"
    assert facts["scene"] == "trihedral"
    assert facts["variant"] == "scalar_rgb"
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(AcquisitionError, match=r"mitsuba.*ltcl\[rig\]"):
        MitsubaRig("box", GRID)


NONSENSE = {"type": "scene", "a": {"type": "projector"}, "b": {"type": "nonsense"}}
ELSEWHERE = {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"scene": 42}, InputTypeError, "scene is a int"),
        ({"scene": "cube.xml"}, FileError, r"cube\.xml: no such file"),
        ({"scene": NONSENSE}, InputError, "nonsense"),
        ({"scene": {"type": "scene"}}, InputError, "scene has 0 projectors"),
        ({"scene": {"type": "projector"}}, InputError, "scene .* one sensor"),
        ({"sensor": ELSEWHERE}, InputError, "scene shows no light"),
        (
            {"scene": {"type": "scene"}, "albedo": 0.5},
            InputError,
            "albedo is given.*dihedral, trihedral, box",
        ),
        ({"albedo": 1.0}, InputError, "albedo .* 1 to 1"),
        ({"baseline": -9.0}, InputError, "baseline is -9"),
        ({"channels": -9.0}, InputError, "channels is -9"),
        ({"sensitivity": -9.0}, InputError, "sensitivity is -9"),
    ],
)
def test_bad_scenes_and_arguments_are_named(
    change: dict[str, Any], error: type[Exception], message: str
) -> None:
    if "sensor" in change:
        change = {"scene": wall(**change)}
    with pytest.raises(error, match=message) as raised:
        MitsubaRig(**{"scene": "box", "projector_grid": GRID, **FAST, **change})
    assert "\n" not in str(raised.value)
