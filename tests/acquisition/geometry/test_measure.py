# SPDX-License-Identifier: BSD-3-Clause
"""Known maps are measured to a few hundredths of a projector pixel, with noise, folds and indirect light."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, measure
from ltcl.errors import AcquisitionError, InputError
from tests.acquisition.geometry.scenes import MAPS, Rig, homography

GRID, CAMERA = (96, 128), (180, 230)


def rms(found: Correspondence, x: np.ndarray | int, y: np.ndarray | int) -> float:
    square = (found.x - x) ** 2 + (found.y - y) ** 2
    return float(np.sqrt(np.mean(square[found.valid])))


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_known_maps_to_a_fraction_of_a_pixel(name, noise):
    x, y = MAPS[name](CAMERA, GRID)
    found = measure(Rig(x, y, GRID, noise=noise), GRID, seconds=1 / 60, high_frequency=False)
    assert found.decoded > 0.99
    assert rms(found, x, y) < 0.2 * np.sqrt(2 / 12)  # of whole numbers: 1/12 is the variance of an axis


@pytest.mark.parametrize("grid", [(64, 64), (45, 37), (17, 60)])
def test_narrow_stripes_are_decoded_under_much_indirect_light(grid):
    x, y = homography((140, 150), grid)
    rig = Rig(x, y, grid, noise=0.002, albedo=0.4, indirect=1.2, full=1 / 30)
    found = measure(rig, grid, seconds=1 / 60)
    assert found.decoded > 0.9
    assert rms(found, x, y) < 0.1


@pytest.mark.parametrize("grid", [(1, 40), (40, 1), (2, 3), (3, 50), (1, 1)])
def test_grids_of_every_shape(grid):
    camera = (max(4 * grid[0], 6), max(4 * grid[1], 6))
    x, y = homography(camera, grid)
    found = measure(Rig(x, y, grid, noise=0.001), grid, seconds=1 / 60, high_frequency=False)
    assert found.decoded > 0.9
    assert rms(found, x if grid[1] > 1 else 0, y if grid[0] > 1 else 0) < 0.25


@pytest.mark.parametrize(("grid", "limit"), [((180, 230), 0.03), ((300, 400), 0.05), ((540, 690), 0.25)])
def test_projector_pixels_smaller_than_camera_pixels(grid, limit):
    """As large, half as large, a third as large; of a camera pixel that is a tenth at most."""
    x, y = homography(CAMERA, grid)
    found = measure(Rig(x, y, grid, noise=0.003), grid, seconds=1 / 60)
    assert found.decoded > 0.99
    assert rms(found, x, y) < limit


@pytest.mark.parametrize("full", [1 / 2000, 1 / 60, 2.0])
def test_an_exposure_is_found_for_dark_and_bright_scenes(full):
    x, y = homography((60, 60), (32, 32))
    assert measure(Rig(x, y, (32, 32), noise=0.003, full=full), (32, 32)).decoded > 0.8


def test_bad_scenes_and_arguments_are_refused():
    x, y = homography((20, 20), (16, 16))
    with pytest.raises(InputError, match="white pattern"):
        measure(Rig(x, y, (16, 16), albedo=0.0, noise=0.0), (16, 16), seconds=1 / 60)
    with pytest.raises(InputError, match="seconds"):
        measure(Rig(x, y, (16, 16)), (16, 16), seconds=0.0)

    class Stale(Rig):
        def photograph(self, codes, seconds):
            return super().photograph(np.ones((16, 16)) * (self.count % 29 != 17), seconds)

    with pytest.raises(AcquisitionError, match="no camera pixel could be decoded"):
        measure(Stale(x, y, (16, 16)), (16, 16), seconds=1 / 60)


def test_a_rig_gets_the_list_of_photographs_and_its_own_exposures_count():
    x, y = homography((40, 50), (16, 16))

    class Camera(Rig):
        levels, exposures, announced = 256, (1 / 500, 1 / 60, 1 / 4), 0

        def prepare(self, shots):
            self.announced += len(list(shots))

        def photograph(self, codes, seconds):
            assert seconds in self.exposures
            return super().photograph(codes, seconds)

    rig = Camera(x, y, (16, 16), bits=8, noise=0.002)
    assert measure(rig, (16, 16)).decoded > 0.9
    assert rig.announced == 2 * 8 + 2
    assert rig.count == rig.announced + 1  # white, to find the exposure
