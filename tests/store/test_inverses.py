# SPDX-License-Identifier: BSD-3-Clause
"""Inverses on disk: the same bits again, and damage refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl.errors import FileError, InputTypeError
from tests.problems import lambertian

GRID = (6, 8)


@pytest.fixture(scope="module")
def colour() -> ltcl.Inverse:
    scenes = [lambertian(48, rho, seed=3) for rho in (0.2, 0.5, 0.8)]
    F = np.stack([scene.F for scene in scenes])
    T = ltcl.Transport([scene.T for scene in scenes], GRID, first_bounce=F, mixing=np.eye(3) + 0.1)
    return ltcl.invert(T, 1e-2, basis="db2")


@pytest.fixture
def path(colour: ltcl.Inverse, tmp_path: Path) -> Path:
    ltcl.save_inverse(tmp_path / "inverse.npz", colour)
    return tmp_path / "inverse.npz"


def test_the_same_bits_come_back(colour: ltcl.Inverse, path: Path) -> None:
    again = ltcl.load_inverse(path)
    assert (again.grid, again.channels, again.errors, again.confidence) == (
        colour.grid,
        3,
        colour.errors,
        colour.confidence,
    )
    np.testing.assert_array_equal(again.first_bounce, colour.first_bounce)
    np.testing.assert_array_equal(again.mixing, colour.mixing)
    desired = np.random.default_rng(0).random((2, *GRID, 3))
    np.testing.assert_array_equal(again.pattern(desired), colour.pattern(desired))
    for ours, kept in zip(again.systems, colour.systems, strict=True):
        assert ours.R.error == kept.R.error


def test_an_inverse_is_no_transport(path: Path) -> None:
    with pytest.raises(FileError, match=r"inverse\.npz: is a precomputed inverse, no transport; load it"):
        ltcl.load(path)


def test_a_transport_is_no_inverse(tmp_path: Path) -> None:
    ltcl.save(tmp_path / "T.npz", ltcl.Transport(np.eye(6), (2, 3)))
    with pytest.raises(FileError, match=r"T\.npz: is no inverse, whose format is ltcl-inverse-1"):
        ltcl.load_inverse(tmp_path / "T.npz")


@pytest.mark.parametrize("name", ["a.npy", "a.mtx", "a"])
def test_only_npz_keeps_it(colour: ltcl.Inverse, tmp_path: Path, name: str) -> None:
    with pytest.raises(FileError, match=r"the extension is .*; inverses are \.npz"):
        ltcl.save_inverse(tmp_path / name, colour)
    assert not (tmp_path / name).exists()


def test_other_things_are_no_inverse(tmp_path: Path) -> None:
    with pytest.raises(InputTypeError, match="inverse is a Transport; it must be what ltcl"):
        ltcl.save_inverse(tmp_path / "a.npz", ltcl.Transport(np.eye(6), (2, 3)))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("errors", None, "the array 'errors', which is missing"),
        ("confidence", None, "the array 'confidence', which is missing"),
        ("grid", np.array([6, 7]), "grid is 6 x 7"),
        ("grid", np.array([6]), "grid has shape"),
        ("errors", np.array([0.1]), "both must be 1 or 3"),
        ("errors", np.array([0.1, 0.1, -1.0]), "error is -1"),
        ("errors", np.array([0.1, 0.1, np.nan]), "NaN"),
        ("confidence", np.array(2.0), "confidence is 2.0"),
        ("first_bounce", np.ones((3, 47)), "grid"),
        ("mixing", np.zeros((3, 3)), "mixing has the condition number"),
        ("system_1.sign", np.array(1.0), "those of an inverse are I - A"),
        ("system_2.R.kind", np.array("magic"), "kind of a stored operator is 'magic'"),
        ("system_0.R.kind", None, "missing"),
    ],
)
def test_parts_that_do_not_fit_are_refused(path: Path, name: str, value, words: str) -> None:
    with np.load(path) as archive:
        arrays = {key: archive[key] for key in archive.files if key != name}
    if value is not None:
        arrays[name] = value
    np.savez(path, **arrays)
    with pytest.raises(FileError, match=words) as refused:
        ltcl.load_inverse(path)
    assert str(refused.value).startswith(str(path))
