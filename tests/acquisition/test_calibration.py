# SPDX-License-Identifier: BSD-3-Clause
"""Codes for a pattern of light, ambient light, and the error of a transport against a known scene."""

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
MIXING = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
UNEVEN = np.tile(np.linspace(0.05, 0.15, 8), 4)


def scanned(
    scene: VirtualRig, store: Path, strategy: str = "pixel", **options: Any
) -> tuple[Any, Setup]:
    return acquire(scene, geometry="aligned", strategy=strategy, store=store, **options), Setup.of(
        store
    )


@pytest.mark.parametrize("channels", [1, 3])
def test_a_picture_is_transport_of_light_and_ambient(tmp_path: Path, channels: int) -> None:
    """In the units of T: a is what the projector's black and the lamps of the room leave."""
    scene = rig(4, ambient=UNEVEN, projector_black=0.03, response="film")
    if channels == 3:
        colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
        room: dict[str, Any] = {"ambient": [0.02, 0.01, 0.03], "mixing": MIXING, "bits": 12}
        scene = VirtualRig(colours, GRID, projector_response=["srgb", "gamma2.2", "linear"], **room)
    T, setup = scanned(scene, tmp_path / "T.zarr")
    shape = GRID if channels == 1 else (*GRID, 3)
    assert (setup.channels, setup.ambient.shape) == (channels, shape)
    p, black = random.random(shape).astype(np.float32), np.zeros(shape, np.float32)
    for light in (p, black, np.ones(shape)):
        picture, expected = (
            np.asarray(T @ light) + setup.ambient,
            scene.radiance(setup.codes(light)),
        )
        for ours, theirs in zip(picture.reshape(32, -1).T, expected.reshape(32, -1).T, strict=True):
            scale = np.vdot(ours, theirs) / np.vdot(ours, ours)
            assert np.linalg.norm(scale * ours - theirs) < 0.02 * np.linalg.norm(theirs)
    assert max(setup.relative_error(scene, T)) < 0.02


def test_codes_give_the_light_that_is_asked_for(tmp_path: Path) -> None:
    _, setup = scanned(
        rig(4, projector_response="gamma2.2", projector_black=0.02), tmp_path / "T.zarr"
    )
    p = np.linspace(0, 1, 32).reshape(GRID)
    np.testing.assert_allclose(setup.codes(p) ** 2.2, p, atol=0.01)
    np.testing.assert_allclose(setup.light(setup.codes(p)), p, atol=1e-3)
    np.testing.assert_array_equal(setup.codes(2 * p - 0.5), setup.codes(np.clip(2 * p - 0.5, 0, 1)))
    for use, name in ((setup.codes, "pattern"), (setup.light, "codes")):
        with pytest.raises(InputError, match=rf"{name} .*\(4, 4\)"):
            use(np.ones((4, 4)))


def test_blocks_are_fed_to_the_pixels_of_the_projector(tmp_path: Path) -> None:
    T, setup = scanned(rig(4, **CLEAN), tmp_path / "T.zarr", "block", block=2, sigmas=0.0)
    assert T.grid == setup.grid == setup.ambient.shape == (2, 4)
    codes = setup.codes(np.arange(8).reshape(2, 4) / 7)
    assert codes.shape == GRID
    np.testing.assert_array_equal(codes[:2, 2:4], codes[0, 2])
    assert setup.relative_error(rig(4, **CLEAN), T)[0] < 0.01
    mirrored = VirtualRig(corner(4)[:, ::-1].copy(), GRID, bits=12)
    assert setup.relative_error(mirrored, T)[0] > 0.2
