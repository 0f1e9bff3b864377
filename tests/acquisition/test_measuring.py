# SPDX-License-Identifier: BSD-3-Clause
"""What is measured of a set-up is what it was made with, and comes back from arrays."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition import Shots, VirtualRig, camera_map, exposing
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.measuring import measure
from ltcl.errors import AcquisitionError, InputError
from ltcl.images import to_srgb

from .scanning.helpers import corner, rig


@pytest.fixture(scope="module")
def found() -> Calibration:
    made = rig(projector_response="gamma2.2", response="gamma2.2", bits=12, ambient=0.02)
    return measure(Shots(made), geometry="aligned")


def test_camera_and_projector(found: Calibration) -> None:
    codes = np.linspace(0.1, 1.0, 10)
    np.testing.assert_allclose(found.projector.linear(codes), codes**2.2, atol=0.01)
    light = np.linspace(0.05, 0.9, 10)
    value = found.response.linear(0.004 + 0.996 * light ** (1 / 2.2))
    np.testing.assert_allclose(value / light, np.mean(value / light), rtol=0.02)
    scale = float(np.mean(value / light))
    assert found.noise.electrons == pytest.approx(10000.0 / scale, rel=0.2)
    np.testing.assert_allclose(found.ambient.value / scale, 0.02, rtol=0.05)
    np.testing.assert_allclose(found.white.value.ravel() / scale, corner().sum(axis=1), rtol=0.03)
    assert found.mixing is None
    assert found.light.tolist() == [1.0]


def test_a_dark_room_around_the_picture_decides_no_exposure() -> None:
    """Three quarters of what the camera sees: 0 but for noise, of which half is above it."""
    grid, size = (6, 8), (48, 64)
    sees = camera_map(lambda u, v: ((u - 20) / 3.2, (v - 14) / 3.2), size, grid)
    made = VirtualRig(
        0.4 * np.eye(48) + 0.002, grid, camera_map=sees, camera_grid=size, bits=12, ambient=0.01
    )
    seen = measure(Shots(made))
    white = seen.resampling.apply(seen.white.value)[seen.resampling.seen]
    assert len(white) >= 44
    np.testing.assert_allclose(white / np.median(white), 1.0, atol=0.1)
    with pytest.raises(InputError, match="half of what white shows saturates at 30 s"):
        measure(Shots(made), exposures=[30.0])


def test_exposures(found: Calibration) -> None:
    """White fills the range in the shortest; the longest leaves ambient light a third of it."""
    short, *_, deep = found.exposures
    assert 0.3 < short * corner().sum(axis=1).max() < 0.95
    assert 0.1 < 0.02 * deep < 0.4


def test_arrays_make_the_same_again(found: Calibration) -> None:
    arrays = found.to_arrays()
    assert all(np.isfinite(array).all() for array in arrays.values())
    again = Calibration.from_arrays(arrays)
    assert (again.exposures, again.noise) == (found.exposures, found.noise)
    for name, array in again.to_arrays().items():
        np.testing.assert_array_equal(array, arrays[name], err_msg=name)
    assert again.resampling.grid == (8, 16)


def test_colours() -> None:
    M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    made = VirtualRig([corner(4)] * 3, (4, 8), mixing=M, bits=12)
    told = measure(Shots(made), geometry="aligned")
    assert told.mixing is not None
    np.testing.assert_allclose(told.mixing, M, atol=0.02)
    np.testing.assert_allclose(told.light, told.mixing.sum(axis=1))


@pytest.mark.parametrize("response", ["srgb", "film"])
def test_colours_have_one_unit(response: str) -> None:
    """Also that of a colour with an eighth of the light of another."""
    walls = [corner(8, albedo) for albedo in (0.8, 0.7, 0.1)]
    shots = Shots(VirtualRig(walls, (8, 16), response=response, bits=12, ambient=0.01))
    white = measure(shots, geometry="aligned").white.value.reshape(-1, 3)
    units = [np.mean(white[:, c] / wall.sum(axis=1)) for c, wall in enumerate(walls)]
    np.testing.assert_allclose(units, np.mean(units), rtol=0.015)


def test_a_camera_with_few_exposures() -> None:
    offered = (0.01, 0.05, 0.2, 0.5, 2.0, 6.0)
    told = measure(Shots(rig(exposures=offered)), geometry="aligned")
    assert set(told.exposures) <= set(offered)
    assert exposing.offered(Shots(rig(exposures=offered)), [0.06, 0.04, 100.0]) == (0.05, 6.0)


def test_a_projector_that_is_off() -> None:
    dark = VirtualRig(np.zeros((16, 16)), (4, 4), ambient=0.1)
    with pytest.raises(AcquisitionError):
        measure(Shots(dark), geometry="aligned")


def test_all_is_saturated() -> None:
    bright = VirtualRig(np.eye(16), (4, 4), ambient=1e6)
    with pytest.raises(AcquisitionError, match="every pixel is saturated under white"):
        measure(Shots(bright), geometry="aligned")


def test_what_is_measured_is_told() -> None:
    told: list[str] = []
    measure(Shots(rig(4)), geometry="aligned", tell=told.append)
    assert told == ["exposure", "response", "geometry", "noise", "exposures", "black", "white", "projector"]


def test_a_map_of_other_pixels_is_refused() -> None:
    from ltcl.acquisition import Correspondence

    with pytest.raises(InputError, match=r"geometry is from \(4, 4\) to \(4, 4\)"):
        measure(Shots(rig(4)), geometry=Correspondence.aligned((4, 4)))
    up = VirtualRig(np.eye(4), (2, 2), camera_grid=(4, 2), camera_map=np.kron(np.eye(4), np.ones((2, 1))))
    with pytest.raises(InputError, match="geometry is 'aligned', but photographs are"):
        measure(Shots(up), geometry="aligned")


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_fewer_bits_than_a_file_has_are_named(bits: int) -> None:
    class Sixteen:
        projector_grid, channels = (4, 8), 1
        made = rig(4, bits=bits)

        def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
            return self.made.photograph(codes, seconds)

    text = f"of white, ends at code {(1 << bits) - 1} of 65535, .* the camera has {bits} bits"
    with pytest.raises(AcquisitionError, match=text):
        measure(Shots(Sixteen()), geometry="aligned")


@pytest.mark.parametrize("grid", [(1, 2), (2, 4), (3, 3), (2, 5)])
@pytest.mark.parametrize("bits", [8, 12])
def test_a_few_pixels_are_measured(grid: tuple[int, int], bits: int) -> None:
    """2 x 5 of 12 bits happen to be at code 511 in the first photograph."""
    n = grid[0] * grid[1]
    found = measure(Shots(VirtualRig(0.5 * np.eye(n) + 0.02, grid, bits=bits)), geometry="aligned", frames=2)
    np.testing.assert_allclose(found.white.value, np.mean(found.white.value), rtol=0.05)
    light = np.linspace(0.1, 0.9, 9)
    codes = 0.004 + 0.996 * to_srgb(light)
    value = found.response.linear(codes)
    np.testing.assert_allclose(value / light, np.mean(value / light), rtol=0.1)
