# SPDX-License-Identifier: BSD-3-Clause
"""Wavelets on the device against their twins, PyWavelets, and what orthonormal means."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import pywt

from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.operators import Wavelet, wavelets
from tests import gallery, reference
from tests.operators import helpers

NAMES = ("haar", "db2", "db4")
GRIDS = ((1, 1), (2, 1), (3, 5), (1, 29), (29, 1), (8, 8), (7, 53))


@pytest.fixture(autouse=True)
def some_columns(monkeypatch):
    """Launches of every width: 1, 2, 3, 4 and 8, and pieces that overlap."""
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 5, 11))


@pytest.fixture(params=["cpu", "gpu"])
def shape_of_launches(request, monkeypatch):
    """Kernels are launched as on either kind of device, whatever this one is."""
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: request.param == "cpu"))


@pytest.fixture(params=[0, 12, 4096], ids=["a launch each", "small ones together", "all in one"])
def small(request, monkeypatch):
    """How many pixels a level may have to be among those that one launch does."""
    monkeypatch.setattr(wavelets, "_SMALL", request.param)


def meets_twins(W: Wavelet) -> None:
    taps = wavelets.filters(W.name)
    helpers.meets_twin(W, reference.wavelet_split(W.grid, W.levels, taps))
    helpers.meets_twin(W.T, reference.wavelet_join(W.grid, W.levels, taps))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.usefixtures("small", "shape_of_launches")
def test_transforms_meet_their_twin(device, grid, name):
    meets_twins(Wavelet(device, grid, name))


@pytest.mark.parametrize("name", [*NAMES, "db38", "sym20"])
@pytest.mark.parametrize("grid", [(8, 8), (16, 2), (12, 20), (128, 256)])
@pytest.mark.filterwarnings("ignore:Level value of")  # sides shorter than the filter are wanted here
def test_coefficients_are_those_of_pywavelets_where_sides_halve_evenly(device, grid, name):
    levels = min(side & -side for side in grid).bit_length() - 1
    x = gallery.vectors(grid[0] * grid[1], None)
    for level in range(1, levels + 1):
        found = helpers.product(Wavelet(device, grid, name, level), x)
        coefficients = pywt.wavedec2(x.reshape(grid).astype(float), name, "periodization", level)
        expected = pywt.coeffs_to_array(coefficients)[0].ravel()
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("grid", [*GRIDS, (37, 40)])
def test_bases_are_orthonormal_and_keep_constants_compact(device, grid, name):
    """A value goes through two passes of a few products a level: some 50 units of the norm."""
    W, n = Wavelet(device, grid, name), grid[0] * grid[1]
    error = 50 * reference.UNIT * (1 + W.levels)
    dense = W.to_dense()
    np.testing.assert_allclose(dense @ dense.T, np.eye(n), rtol=0, atol=2 * error)
    constant = np.zeros(n)
    constant[0] = np.float32(0.7) * np.sqrt(n)
    product = helpers.product(W, np.full(n, 0.7, np.float32))
    np.testing.assert_allclose(product, constant, rtol=0, atol=error * constant[0])


SMALL_GROUPS = """
import numpy as np
import scipy.sparse
import ltcl
from ltcl.device import Device
from ltcl.operators import Pyramid, SubsetBasis, Tiles, Wavelet
device = ltcl.open_device()
assert device.max_group == {size}
Device.is_cpu = property(lambda _: False)
x = np.random.default_rng(0).random((70 * 90, 3)).astype(np.float32)
W = Wavelet(device, (70, 90))
assert abs(W.T @ (W @ x) - x).max() < 1e-5
P = Pyramid(device, (70, 90))
assert abs((P @ x)[-1] - x.sum(axis=0)).max() < 1
assert (P.T @ np.eye(P.shape[0])[-1] == 1).all()
S = SubsetBasis(device, (70, 90), np.arange(0, 6300, 7))
assert (S @ x == x[::7]).all()
A = np.where(np.arange(60 * 6300).reshape(60, 6300) % 5, 0, 1).astype(np.float32)
assert abs(Tiles(device, scipy.sparse.csr_array(A)) @ x - A @ x).max() < 0.01
"""


@pytest.mark.parametrize("size", [8, 64])
def test_small_work_groups_will_do_in_the_shape_of_a_gpu(size):
    environment = {**os.environ, "POCL_MAX_WORK_GROUP_SIZE": str(size)}
    script = SMALL_GROUPS.format(size=size)
    subprocess.run([sys.executable, "-c", script], env=environment, check=True, timeout=120)


@pytest.mark.parametrize("grid", [(20000, 1), (1, 40000)])
def test_long_lines_need_more_than_an_item_has(device, grid):
    W = Wavelet(device, grid, "haar")
    x = gallery.vectors(grid[0] * grid[1], None)
    a = helpers.product(W, x)
    assert a[0] == pytest.approx(x.sum(dtype=np.float64) / np.sqrt(x.size), abs=1e-4)
    np.testing.assert_allclose(helpers.product(W.T, a), x, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        *((((8, 8), name), f"{name}.*haar") for name in ("bior2.2", "rbio1.3", "dmey")),
        *((((8, 8), name), f"wavelet is {name!r}.*haar") for name in ("db99", "morl", "", None, 2)),
        *((((8, 5), "haar", levels), f"levels is {levels!r}") for levels in (4, -1, 1.5, "3")),
        *(((grid, "haar"), "grid is") for grid in ((0, 4), (2.5, 2), 9, (1, 2, 3))),
    ],
)
def test_what_is_no_transform_is_refused(device, arguments, part):
    with pytest.raises(InputError, match=part):
        Wavelet(device, *arguments)
