# SPDX-License-Identifier: BSD-3-Clause
"""Known maps are measured to a few hundredths of a projector pixel, with noise, folds and indirect light."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.geometry import PhaseShift, measure
from ltcl.errors import AcquisitionError, InputError
from tests.acquisition.geometry.scenes import MAPS, Rig, homography

GRID, CAMERA = (96, 128), (180, 230)


def rms(found, x, y) -> float:
    off = (found.x - x) ** 2 + (found.y - y) ** 2
    return float(np.sqrt(np.mean(off[found.valid])))


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize(("phase", "limit"), [(False, 0.08), (True, 0.05)])
@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_known_maps_to_a_fraction_of_a_pixel(name, phase, limit, noise):
    x, y = MAPS[name](CAMERA, GRID)
    found = measure(Rig(x, y, GRID, noise=noise), GRID, phase=phase, seconds=1 / 60, high_frequency=False)
    assert found.decoded > 0.99
    assert rms(found, x, y) < limit


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_whole_numbers_are_uniformly_wrong_and_planes_are_not(noise):
    """A whole number for a place in its cell has variance 1/12 an axis: edges must beat that by far."""
    x, y = homography(CAMERA, GRID)
    found = measure(Rig(x, y, GRID, noise=noise), GRID, phase=False, seconds=1 / 60, high_frequency=False)
    assert rms(found, x, y) < 0.2 * np.sqrt(2 / 12)


@pytest.mark.parametrize("grid", [(64, 64), (45, 37), (17, 60)])
def test_narrow_stripes_see_through_much_indirect_light(grid):
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


def test_projector_pixels_smaller_than_camera_pixels():
    grid = (300, 400)
    x, y = homography(CAMERA, grid)
    for phase in (False, True, None):
        found = measure(Rig(x, y, grid, noise=0.003), grid, phase=phase, seconds=1 / 60)
        assert found.decoded > 0.99
        assert rms(found, x, y) < 0.15


def test_six_steps_bear_a_projector_that_is_not_linear():
    grid = (1, 256)
    x, y = homography((3, 500), grid)
    images = {}
    for steps in (3, 6):
        shift, rig = PhaseShift(grid, (256.0, 32.0), steps), Rig(x, 0 * y, grid, noise=0, gamma=2.2)
        found, _ = shift.decode([rig.photograph(p, 1 / 60) for p in shift.patterns()])
        images[steps] = np.sqrt(np.mean((found.value - x)[:, 60:-60] ** 2))
    assert images[6] < 0.05 < images[3]


@pytest.mark.parametrize("grid", [(64, 100), (1, 37), (33, 1)])
def test_phases_of_falling_periods_need_no_gray_code(grid):
    shift = PhaseShift(grid, (100.0, 20.0, 6.0), steps=4)
    y, x = np.mgrid[: grid[0], : grid[1]]
    for axis, wanted in zip(shift.decode(shift.patterns()), (x, y), strict=True):
        assert np.abs(axis.value - wanted).max() < 1e-3


def test_phase_of_noise_reaches_its_bound():
    """Cramer-Rao: a deviation of sqrt(2 / K) sigma / b of the phase, in radians."""
    shift, sigma = PhaseShift((1, 200), (200.0,), steps=8), 0.01
    rng = np.random.default_rng(5)
    images = [np.repeat(p, 400, axis=0) for p in shift.patterns()]
    found, _ = shift.decode([i + sigma * rng.standard_normal(i.shape) for i in images])
    off = (found.value - np.arange(200))[:, 10:-10]
    bound = np.sqrt(2 / 8) * sigma / 0.5 * 200 / (2 * np.pi)
    assert np.std(off) == pytest.approx(bound, rel=0.03)


def test_exposure_is_found_where_none_is_given():
    x, y = homography((60, 60), (32, 32))
    for full in (1 / 2000, 1 / 60, 2.0):
        assert measure(Rig(x, y, (32, 32), noise=0.003, full=full), (32, 32)).decoded > 0.8


def test_what_cannot_be_measured_is_refused():
    x, y = homography((20, 20), (16, 16))
    with pytest.raises(InputError, match="white pattern"):
        measure(Rig(x, y, (16, 16), albedo=0.0, noise=0.0), (16, 16), seconds=1 / 60)
    with pytest.raises(InputError, match="seconds"):
        measure(Rig(x, y, (16, 16)), (16, 16), seconds=0.0)

    class Stale(Rig):
        def photograph(self, codes, seconds):
            return super().photograph(np.ones((16, 16)) * (self.taken % 29 != 17), seconds)

    with pytest.raises(AcquisitionError, match="no camera pixel could be decoded"):
        measure(Stale(x, y, (16, 16)), (16, 16), seconds=1 / 60)


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"periods": (8.0, 8.0)}, "periods are"),
        ({"periods": ()}, "periods are"),
        ({"periods": (2.0,)}, "periods\\[0\\] is"),
        ({"steps": 2}, "steps is 2"),
    ],
)
def test_phase_shifts_that_tell_nothing_are_refused(options, part):
    with pytest.raises(InputError, match=part):
        PhaseShift((8, 8), **options)


def test_a_period_shorter_than_the_grid_needs_gray_code():
    shift = PhaseShift((8, 32))
    with pytest.raises(InputError, match="span the 32 pixels"):
        shift.decode(shift.patterns())


def test_a_rig_hears_what_comes_next_and_its_steps_count():
    x, y = homography((40, 50), (16, 16))

    class Camera(Rig):
        levels, exposures, told = 256, (1 / 500, 1 / 60, 1 / 4), 0

        def prepare(self, shots):
            self.told += len(list(shots))

        def photograph(self, codes, seconds):
            assert seconds in self.exposures
            return super().photograph(codes, seconds)

    for phase, shots in ((None, 0), (False, 0), (True, 2 * 6)):
        rig = Camera(x, y, (16, 16), bits=8, noise=0.002)
        assert measure(rig, (16, 16), phase=phase).decoded > 0.9
        assert rig.told == 2 * 8 + 2 + shots  # a camera that resolves the projector's pixels needs no phase
        assert rig.taken == rig.told + 1  # white, to find the exposure
