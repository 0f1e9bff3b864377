# SPDX-License-Identifier: BSD-3-Clause
"""Codes for a pattern of light, ambient light, and how far a transport is from a known scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Setup, VirtualRig, acquire, held
from ltcl.acquisition.setup import has_calibration
from ltcl.errors import FileError, InputError
from ltcl.store import BlockStore

from .scanning.helpers import CLEAN, corner, rig

GRID = (4, 8)


def scanned(made: VirtualRig, store: Path, strategy: str = "pixel", **options: Any) -> Any:
    return acquire(made, geometry="aligned", strategy=strategy, store=store, **options)


def test_codes_give_the_light_that_is_asked_for(tmp_path: Path) -> None:
    made = rig(4, projector_response="gamma2.2", projector_black=0.02)
    scanned(made, tmp_path / "T.zarr")
    setup = Setup.of(tmp_path / "T.zarr")
    p = np.linspace(0, 1, 32).reshape(GRID)
    np.testing.assert_allclose(setup.codes(p) ** 2.2, p, atol=0.01)
    np.testing.assert_array_equal(setup.codes(2 * p - 0.5), setup.codes(np.clip(2 * p - 0.5, 0, 1)))
    with pytest.raises(InputError, match=r"pattern has shape \(4, 4\)"):
        setup.codes(np.ones((4, 4)))


def test_a_picture_is_transport_of_light_and_ambient(tmp_path: Path) -> None:
    """In the units of T: what the projector's black and the lamps of the room leave is a."""
    y, x = np.mgrid[:4, :8] / 8
    room = 0.05 + 0.1 * x.ravel()
    made = rig(4, ambient=room, projector_black=0.03, response="film")
    T = scanned(made, tmp_path / "T.zarr")
    setup = Setup.of(tmp_path / "T.zarr")
    p = (0.3 + 0.5 * np.cos(3 * y + x) ** 2).astype(np.float32)
    found = np.asarray(T @ p) + setup.ambient
    wanted = made.radiance(setup.codes(p))
    scale = np.vdot(found, wanted) / np.vdot(found, found)
    np.testing.assert_allclose(scale * found, wanted, rtol=0.03)
    np.testing.assert_allclose(scale * setup.ambient, made.radiance(np.zeros(GRID)), rtol=0.03)
    white = scale * (setup.white + setup.ambient)
    np.testing.assert_allclose(white, made.radiance(np.ones(GRID)), rtol=0.03)


def test_blocks_are_fed_to_the_pixels_of_the_projector(tmp_path: Path) -> None:
    made = rig(4, **CLEAN)
    T = scanned(made, tmp_path / "T.zarr", "block", block=2, sigmas=0.0)
    setup = Setup.of(tmp_path / "T.zarr")
    assert (T.grid, setup.grid, setup.ambient.shape) == ((2, 4), (2, 4), (2, 4))
    codes = setup.codes(np.arange(8).reshape(2, 4) / 7)
    assert codes.shape == GRID
    np.testing.assert_array_equal(codes[:2, 2:4], codes[0, 2])
    assert held.off(made, T, setup)[0] < 0.01


def test_colours_have_responses_of_their_own(tmp_path: Path) -> None:
    M = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
    curves = ["srgb", "gamma2.2", "linear"]
    colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    made = VirtualRig(colours, GRID, mixing=M, bits=12, ambient=[0.02, 0.01, 0.03], projector_response=curves)
    T = scanned(made, tmp_path / "T.zarr")
    setup = Setup.of(tmp_path / "T.zarr")
    assert (setup.channels, setup.ambient.shape) == (3, (*GRID, 3))
    p = np.random.default_rng(0).random((*GRID, 3)).astype(np.float32)
    found, wanted = np.asarray(T @ p) + setup.ambient, made.radiance(setup.codes(p))
    for c in range(3):
        scale = np.vdot(found[..., c], wanted[..., c]) / np.vdot(found[..., c], found[..., c])
        assert np.linalg.norm(scale * found[..., c] - wanted[..., c]) < 0.02 * np.linalg.norm(wanted[..., c])
    grey = setup.codes(np.full(GRID, 0.5))
    np.testing.assert_allclose(grey[0, 0], [0.735, 0.73, 0.5], atol=0.01)
    assert max(held.off(made, T, setup)) < 0.02


def test_a_wrong_transport_is_far_off(tmp_path: Path) -> None:
    made = rig(4)
    T = scanned(made, tmp_path / "T.zarr")
    setup = Setup.of(tmp_path / "T.zarr")
    assert held.off(made, T, setup)[0] < 0.02
    other = VirtualRig(corner(4)[:, ::-1].copy(), GRID, bits=12)
    assert held.off(other, T, setup)[0] > 0.2


def test_only_what_was_acquired_has_a_setup(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    BlockStore.create(path, shape=(32, 32), grid=GRID)
    assert not has_calibration(path)
    assert not has_calibration(tmp_path)
    with pytest.raises(FileError, match="holds no calibration"):
        Setup.of(path)
