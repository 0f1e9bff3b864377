# SPDX-License-Identifier: BSD-3-Clause
"""What is measured of a set-up is what it was made with, in few photographs, and comes back from arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Correspondence, FolderRig, Shots, VirtualRig, acquire, calibrate, camera_map
from ltcl.acquisition.calibrate import measure
from ltcl.acquisition.calibration import Calibration
from ltcl.errors import AcquisitionError, InputError, PhotographMissing

from .scanning.helpers import corner, held, rig, unit

GRID = (8, 16)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    made = rig(projector_response="gamma2.2", response="gamma2.2", bits=12, ambient=0.02)
    return measure(Shots(made), geometry="aligned")


def test_camera_and_projector(calibration: Calibration) -> None:
    codes = np.linspace(0.1, 1.0, 10)
    np.testing.assert_allclose(calibration.projector.linear(codes), codes**2.2, atol=0.01)
    light = np.linspace(0.05, 0.9, 10)
    value = calibration.response.linear(0.004 + 0.996 * light ** (1 / 2.2))
    np.testing.assert_allclose(value / light, np.mean(value / light), rtol=0.02)
    scale = float(np.mean(value / light))
    assert calibration.noise.electrons == pytest.approx(10000.0 / scale, rel=0.2)
    np.testing.assert_allclose(calibration.ambient.value / scale, 0.02, rtol=0.05)
    np.testing.assert_allclose(calibration.white.value.ravel() / scale, corner().sum(axis=1), rtol=0.03)
    assert calibration.light.tolist() == [1.0]
    short, *_, longest = calibration.exposures
    assert 0.3 < short * corner().sum(axis=1).max() < 0.95
    assert 0.1 < 0.02 * longest < 0.7


def test_arrays_make_the_same_again(calibration: Calibration) -> None:
    arrays = calibration.to_arrays()
    assert all(np.isfinite(array).all() for array in arrays.values())
    again = Calibration.from_arrays(arrays)
    assert (again.exposures, again.noise) == (calibration.exposures, calibration.noise)
    for name, array in again.to_arrays().items():
        np.testing.assert_array_equal(array, arrays[name], err_msg=name)
    assert again.resampling.grid == GRID


def test_a_dark_room_around_the_picture_decides_no_exposure() -> None:
    """Three quarters of what the camera sees: 0 but for noise, of which half is above it."""
    grid, size = (6, 8), (48, 64)
    sees = camera_map(lambda u, v: ((u - 20) / 3.2, (v - 14) / 3.2), size, grid)
    T = 0.4 * np.eye(48) + 0.002
    made = VirtualRig(T, grid, camera_map=sees, camera_grid=size, bits=12, ambient=0.01)
    seen = measure(Shots(made))
    white = seen.resampling.apply(seen.white.value)[seen.resampling.seen]
    assert len(white) >= 44
    assert np.quantile(np.abs(white / np.median(white) - 1), 0.9) < 0.1
    with pytest.raises(InputError, match=r"saturates at 30 s"):
        measure(Shots(made), exposures=[30.0])


def test_colours_that_mix() -> None:
    M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    made = VirtualRig([corner(4)] * 3, (4, 8), mixing=M, bits=12)
    mixing = measure(Shots(made), geometry="aligned").mixing
    assert mixing is not None
    np.testing.assert_allclose(mixing, M, atol=0.02)


@pytest.mark.parametrize("response", ["srgb", "film"])
def test_colours_have_one_unit(response: str) -> None:
    """Also that of a colour with an eighth of the light of another."""
    walls = [corner(8, albedo) for albedo in (0.8, 0.7, 0.1)]
    shots = Shots(VirtualRig(walls, GRID, response=response, bits=12, ambient=0.01))
    white = measure(shots, geometry="aligned").white.value.reshape(-1, 3)
    units = [np.mean(white[:, c] / wall.sum(axis=1)) for c, wall in enumerate(walls)]
    np.testing.assert_allclose(units, np.mean(units), rtol=0.02)


def test_a_camera_with_few_exposures() -> None:
    offered = (0.01, 0.05, 0.2, 0.5, 2.0, 6.0)
    assert set(measure(Shots(rig(exposures=offered)), geometry="aligned").exposures) <= set(offered)


@pytest.mark.parametrize(
    ("made", "given", "error", "part"),
    [
        (VirtualRig(np.zeros((64, 64)), (8, 8), ambient=0.1), "aligned", AcquisitionError, "white.*black"),
        (VirtualRig(np.eye(16), (4, 4), ambient=1e6), "aligned", AcquisitionError, "saturated.*0.0001 s"),
        (rig(4), Correspondence.aligned((4, 4)), InputError, r"geometry.*\(4, 4\).*\(4, 8\)"),
        (
            VirtualRig(np.eye(4), (2, 2), camera_grid=(4, 2), camera_map=np.kron(np.eye(4), [[1], [1]])),
            "aligned",
            InputError,
            r"geometry is 'aligned'.*\(4, 2\)",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused(made: Any, given: Any, error: Any, part: str) -> None:
    with pytest.raises(error, match=part):
        measure(Shots(made), geometry=given)


@pytest.mark.parametrize("bits", [10, 14])
def test_fewer_bits_than_a_file_has_are_named(bits: int) -> None:
    class Sixteen:
        projector_grid, channels = (4, 8), 1
        made = rig(4, bits=bits)

        def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
            return self.made.photograph(codes, seconds)

    with pytest.raises(AcquisitionError, match=f"{(1 << bits) - 1} of 65535.*must be {bits}"):
        measure(Shots(Sixteen()), geometry="aligned")


def askance(u: Any, v: Any) -> tuple[Any, Any]:
    """Three camera pixels to each side of one of 8 x 16, of a picture seen in perspective."""
    a, b = u / 3 - 0.8, v / 3 - 0.6
    d = 1 + 0.008 * a - 0.01 * b
    return (a + 0.1 * b) / d - 0.4, (b - 0.05 * a) / d + 0.3


@pytest.mark.parametrize("by_hand", [False, True])
@pytest.mark.parametrize(("geometry", "channels"), [("graycode", 1), ("aligned", 1), ("graycode", 3)])
def test_the_number_of_photographs_is_known_before(geometry: str, channels: int, by_hand: bool) -> None:
    more: dict[str, Any] = {"camera_grid": (27, 50), "camera_map": camera_map(askance, (27, 50), GRID)}
    made: Any = rig(bits=8, **more if geometry == "graycode" else {})
    if channels == 3:
        made = VirtualRig([corner()] * 3, GRID, ambient=0.01, **more)
    made.keeps_photographs = by_hand
    shots, steps = Shots(made), []
    measure(shots, geometry=geometry, progress=lambda *step: steps.append(step))
    expected = calibrate.photographs(GRID, channels=channels, aligned=geometry == "aligned", by_hand=by_hand)
    assert shots.count == pytest.approx(expected, rel=0.1)
    assert [done for _, done, _ in steps] == [*range(1, shots.count + 1), shots.count]
    assert {step for step, *_ in steps} == {"calibration"}
    assert steps[-1][1] == steps[-1][2]


def test_a_hand_made_scan_takes_at_most_300_photographs(tmp_path: Path) -> None:
    """8 x 16 pixels, a camera of 8 bits, all defaults; T p within 1.1 %."""
    C, folder = camera_map(askance, (27, 50), GRID), tmp_path / "photos"
    lit = rig(bits=8, camera_grid=(27, 50), camera_map=C)
    rounds, T = 0, None
    while T is None:
        try:
            T = acquire(FolderRig(folder, GRID, 1), store=tmp_path / "T.zarr")
        except PhotographMissing:
            rounds += 1
            photograph_the_list(lit, folder)
    assert rounds <= 7
    assert len(list((folder / "photographs").iterdir())) <= 300
    seen, found = ~T.masked, np.asarray(T @ np.eye(128).reshape(128, *GRID), np.float64).reshape(128, 128).T
    ours, theirs = (
        (unit(found[seen], corner()[seen]) * found @ held(GRID))[seen],
        (corner() @ held(GRID))[seen],
    )
    assert np.max(np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)) < 0.011
    assert ltcl.load(tmp_path / "T.zarr", on_dark="mask").grid == GRID


def photograph_the_list(lit: VirtualRig, folder: Path) -> None:
    """Take what is on the list and not there yet, as a person does."""
    for row in (folder / "shots.csv").read_text().splitlines()[1:]:
        _, pattern, seconds, save = row.split(",")
        target = folder / f"{save}.png"
        if not target.exists():
            codes = np.float32(cv2.imread(str(folder / pattern), cv2.IMREAD_UNCHANGED)) / 255
            cv2.imwrite(str(target), lit.photograph(codes, float(seconds)))
