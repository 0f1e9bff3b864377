# SPDX-License-Identifier: BSD-3-Clause
"""Codes for a pattern, ambient light, and the error of a transport against a known scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Setup, VirtualRig, acquire
from ltcl.errors import InputError

from .scanning.helpers import CLEAN, corner, rig

random = np.random.default_rng(0)
GRID = (4, 8)
UNEVEN = np.tile(np.linspace(0.05, 0.15, 8), 4)


def scanned(
    scene: VirtualRig, store: Path, strategy: str = "pixel", **options: Any
) -> tuple[Any, Setup]:
    """The transport and the set-up of a scan."""
    T = acquire(scene, geometry="aligned", strategy=strategy, store=store, **options)
    return T, Setup.of(store)


def coloured_rig() -> VirtualRig:
    """A rig whose channels differ in everything."""
    return VirtualRig(
        [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)],
        GRID,
        projector_response=["srgb", "gamma2.2", "linear"],
        ambient=[0.02, 0.01, 0.03],
        mixing=np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]]),
        bits=12,
    )


@pytest.mark.slow
@pytest.mark.parametrize("channels", [1, 3])
def test_a_picture_is_transport_of_light_and_ambient(tmp_path: Path, channels: int) -> None:
    """Ambient light in the units of T is that of the projector's black and of the room."""
    if channels == 3:
        scene = coloured_rig()
        shape: tuple[int, ...] = (*GRID, 3)
    else:
        scene = rig(4, ambient=UNEVEN, projector_black=0.03, response="film")
        shape = GRID
    T, setup = scanned(scene, tmp_path / "T.zarr")
    assert setup.channels == channels
    assert setup.ambient.shape == shape
    black = np.zeros(shape, np.float32)
    for light in (random.random(shape).astype(np.float32), black, np.ones(shape)):
        picture = np.reshape(T @ light + setup.ambient, (32, channels))
        expected = np.reshape(scene.radiance(setup.codes(light)), (32, channels))
        scale = np.sum(picture * expected, axis=0) / np.sum(picture**2, axis=0)
        error = np.linalg.norm(scale * picture - expected, axis=0)
        assert (error < 0.02 * np.linalg.norm(expected, axis=0)).all()
    assert max(setup.relative_error(scene, T)) < 0.02


@pytest.mark.slow
def test_codes_give_the_light_that_is_asked_for(tmp_path: Path) -> None:
    camera = rig(4, projector_response="gamma2.2", projector_black=0.02)
    _, setup = scanned(camera, tmp_path / "T.zarr")
    p = np.linspace(0, 1, 32).reshape(GRID)
    np.testing.assert_allclose(setup.codes(p) ** 2.2, p, atol=0.01)
    np.testing.assert_allclose(setup.light(setup.codes(p)), p, atol=1e-3)
    too_much = 2 * p - 0.5
    np.testing.assert_array_equal(setup.codes(too_much), setup.codes(np.clip(too_much, 0, 1)))
    with pytest.raises(InputError, match=r"pattern .*\(4, 4\)"):
        setup.codes(np.ones((4, 4)))
    with pytest.raises(InputError, match=r"codes .*\(4, 4\)"):
        setup.light(np.ones((4, 4)))


@pytest.mark.slow
def test_blocks_are_fed_to_the_pixels_of_the_projector(tmp_path: Path) -> None:
    camera = rig(4, **CLEAN)
    T, setup = scanned(camera, tmp_path / "T.zarr", "block", block=2, sigmas=0.0)
    assert T.grid == setup.grid == setup.ambient.shape == (2, 4)
    codes = setup.codes(np.arange(8).reshape(2, 4) / 7)
    assert codes.shape == GRID
    np.testing.assert_array_equal(codes[:2, 2:4], codes[0, 2])
    assert setup.relative_error(camera, T)[0] < 0.01
    mirrored = VirtualRig(corner(4)[:, ::-1].copy(), GRID, bits=12)
    assert setup.relative_error(mirrored, T)[0] > 0.2
