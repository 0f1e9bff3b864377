# SPDX-License-Identifier: BSD-3-Clause
"""Wavelets, pyramids, subsets of coefficients and the support of a core."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
import pywt
import scipy.sparse

from ltcl.operators import (
    CSR,
    Compressed,
    Hats,
    PatchHats,
    Planes,
    Pyramid,
    SubsetBasis,
    Wavelet,
    bases,
    multiresolution_order,
    restrict_to_support,
    wavelets,
)
from tests import gallery, reference
from tests.conftest import launched_as
from tests.operators import helpers

NAMES = ("haar", "db2", "db4")
GRIDS = ((1, 1), (2, 1), (3, 5), (1, 29), (29, 1), (8, 8), (7, 53))


def some(n: int, share: int = 3) -> np.ndarray:
    """A part of n places, or one, in no order; share 1: all of them."""
    return np.random.default_rng(4).permutation(n)[: max(1, n // share)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "small", [0, 12, 4096], ids=["a launch each", "small ones together", "all in one"]
)
@pytest.mark.parametrize("name", ["haar", "db4", "pyramid", "hats"])
@pytest.mark.parametrize("grid", GRIDS)
def test_transforms_meet_their_twins(shaped, monkeypatch, grid, name, small):
    monkeypatch.setattr(bases, "small_level_pixels", lambda device: small)
    # Launches of every width, and pieces.
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 5, 11))
    if name == "pyramid":
        W = Pyramid(shaped, grid)
        matrix = reference.pyramid_gather(np.eye(W.shape[1]).reshape(*grid, -1))
        transposed = reference.pyramid_spread(grid)
    elif name == "hats":
        W = Hats(shaped, grid)
        matrix = reference.hats_gather(grid)
        transposed = reference.hats_spread(grid)
    else:
        W = Wavelet(shaped, grid, name)
        filters = wavelets.filters(name)
        matrix = reference.wavelet_split(grid, W.levels, filters)
        transposed = reference.wavelet_join(grid, W.levels, filters)
    helpers.meets_twin(W, matrix)
    helpers.meets_twin(W.T, transposed)


@pytest.mark.parametrize(
    ("grid", "walls", "detail"),
    [((1, 1), 1, 1), ((3, 10), 5, 1), ((4, 12), 3, 4), ((6, 12), 1, 2), ((15, 50), 2, 5)],
)
def test_patch_hats_meet_their_twin(shaped, grid, walls, detail):
    W = PatchHats(shaped, grid, walls, detail)
    matrix = reference.patch_hats(grid, walls, detail)
    helpers.meets_twin(W, matrix)
    helpers.meets_twin(W.T, matrix.T)
    # Each pixel is shared in full, and each patch has as much of its pixels as they are many.
    np.testing.assert_allclose(matrix.sum(axis=0), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(matrix.sum(axis=1), detail**2, rtol=0, atol=1e-12)
    core = np.random.default_rng(3).random((len(matrix), len(matrix)))
    expected = np.diagonal(matrix.T @ core @ matrix)
    np.testing.assert_allclose(W.diagonal_of(core), expected, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("share", [1, 3])
# The last grid has more pixels than items.
@pytest.mark.parametrize("grid", [(1, 1), (9, 8), (20000, 1)])
def test_subsets_meet_their_twin(shaped, grid, share):
    n = grid[0] * grid[1]
    places = some(n, share)
    P = SubsetBasis(shaped, grid, places)
    x = gallery.vectors(n, 3)
    helpers.same_bits(helpers.product(P, x), reference.ordered_gather(places, x).astype(np.float32))
    helpers.same_bits(helpers.product(P.T, x[places])[places], x[places])
    if n < 100:
        helpers.meets_twin(P.T, reference.ordered_gather(places, np.eye(n)).T)
    assert P.nbytes == 4 * (len(places) + n)
    assert P.isometric
    assert P.orthonormal == (len(places) == n)


@pytest.mark.slow
@pytest.mark.parametrize("small", [0, 4096], ids=["a launch each", "all in one"])
@pytest.mark.parametrize("share", [1, 3])
@pytest.mark.parametrize("name", ["haar", "db4"])
@pytest.mark.parametrize("grid", [(1, 1), (3, 5), (1, 29), (7, 53)])
def test_subsets_of_coefficients_meet_their_twins(shaped, monkeypatch, grid, name, share, small):
    """A GPU picks them while it transforms; a CPU afterwards."""
    monkeypatch.setattr(bases, "small_level_pixels", lambda device: small)
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 11))
    W = Wavelet(shaped, grid, name)
    places = some(grid[0] * grid[1], share)
    matrix = reference.wavelet_split(grid, W.levels, wavelets.filters(name))
    P = SubsetBasis(shaped, grid, places, W)
    helpers.meets_twin(P, matrix[places])
    helpers.meets_twin(
        P.T, reference.wavelet_join(grid, W.levels, wavelets.filters(name))[:, places]
    )


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_subsets_of_the_coefficients_of_several_pictures_meet_their_twin(shaped, count):
    """Each picture has coefficients of its own."""
    grid = (7, 10)
    matrix = reference.wavelet_split(grid, 4, wavelets.filters("db2"))
    whole = np.kron(np.eye(count), matrix)
    places = some(len(whole))
    W = Planes(Wavelet(shaped, grid, "db2"), count)
    P = SubsetBasis(shaped, (count * grid[0], grid[1]), places, W)
    helpers.meets_twin(P, whole[places])
    helpers.meets_twin(P.T, whole[places].T)


def test_a_gpu_picks_coefficients_without_a_launch_of_its_own(device):
    gpu = launched_as(device, "gpu")
    W = Wavelet(gpu, (40, 40), "haar")
    P = SubsetBasis(gpu, (40, 40), some(1600), W)
    launches = []
    for A in (W, P, W.T, P.T):
        x = gpu.upload(gallery.vectors(A.shape[1], 3))
        before = gpu.launches.total()
        A.apply(x)
        launches.append(gpu.launches.total() - before)
    gpu.finish()
    assert launches == [1, 1, 1, 1]


# Largest group, bytes of local memory, and the launches of a transform of 40 x 56 pixels: where
# local memory holds all levels, some of them, and none.
TAILS = [(1024, 49152, 1), (1024, 4096, 2), (8, 49152, 4), (1024, 4, 6)]


@pytest.mark.slow
@pytest.mark.parametrize(("max_group", "local_memory", "launches"), TAILS)
@pytest.mark.parametrize("k", [None, 3, 8])
def test_a_gpu_keeps_small_levels_in_local_memory(device, max_group, local_memory, launches, k):
    """Results are those of a launch for each level, also for coefficients in another order."""
    grid = (40, 56)
    gpu = launched_as(device, "gpu")
    gpu.max_group = max_group
    gpu.local_memory = local_memory
    W = Wavelet(gpu, grid, "db2")
    n = grid[0] * grid[1]
    x = gallery.vectors(n, k)
    before = gpu.launches.total()
    coefficients = helpers.product(W, x)
    assert gpu.launches.total() - before == launches
    expected = helpers.product(Wavelet(device, grid, "db2"), x)
    np.testing.assert_allclose(coefficients, expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(helpers.product(W.T, coefficients), x, rtol=0, atol=1e-5)
    places = some(n)
    P = SubsetBasis(gpu, grid, places, W)
    np.testing.assert_array_equal(helpers.product(P, x), coefficients[places])
    chosen = np.zeros_like(coefficients)
    chosen[places] = coefficients[places]
    np.testing.assert_array_equal(
        helpers.product(P.T, coefficients[places]), helpers.product(W.T, chosen)
    )


@pytest.mark.parametrize("name", [*NAMES, "db38", "sym20"])
@pytest.mark.parametrize("grid", [(8, 8), (16, 2), (12, 20), (128, 256)])
# Sides are shorter than the filter on purpose.
@pytest.mark.filterwarnings("ignore:Level value of")
def test_coefficients_are_those_of_pywavelets_where_sides_halve_evenly(device, grid, name):
    levels = min(side & -side for side in grid).bit_length() - 1
    x = gallery.vectors(grid[0] * grid[1], None)
    for level in range(1, levels + 1):
        coefficients = pywt.wavedec2(x.reshape(grid).astype(float), name, "periodization", level)
        expected = pywt.coeffs_to_array(coefficients)[0].ravel()
        product = helpers.product(Wavelet(device, grid, name, level), x)
        np.testing.assert_allclose(product, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("grid", [*GRIDS, (37, 40)])
def test_wavelets_are_orthonormal_and_keep_constants_compact(device, grid, name):
    """A value goes through two passes of a few products a level: some 50 units of the norm."""
    W = Wavelet(device, grid, name)
    n = grid[0] * grid[1]
    error = 50 * reference.UNIT * (1 + W.levels)
    dense = W.to_dense()
    np.testing.assert_allclose(dense @ dense.T, np.eye(n), rtol=0, atol=2 * error)
    constant = np.float32(0.7) * np.sqrt(n) * np.eye(1, n)[0]
    product = helpers.product(W, np.full(n, 0.7, np.float32))
    np.testing.assert_allclose(product, constant, rtol=0, atol=error * constant[0])


@pytest.mark.parametrize("kind", [Wavelet, Pyramid, Hats])
def test_a_picture_takes_four_launches(device, kind):
    W = kind(device, (256, 512))
    for A in (W, W.T):
        x = device.upload(gallery.vectors(A.shape[1], 3))
        before = device.launches.total()
        A.apply(x)
        assert device.launches.total() - before <= 4


@pytest.mark.parametrize("grid", [(20000, 1), (1, 40000)])
def test_long_lines_need_more_than_an_item_has(device, grid):
    W = Wavelet(device, grid, "haar")
    x = gallery.vectors(grid[0] * grid[1], None)
    a = helpers.product(W, x)
    assert a[0] == pytest.approx(x.sum(dtype=np.float64) / np.sqrt(x.size), abs=1e-4)
    np.testing.assert_allclose(helpers.product(W.T, a), x, rtol=0, atol=1e-5)


SMALL_GROUPS = """
import numpy as np
import scipy.sparse
import ltcl
from ltcl.operators import Pyramid, SubsetBasis, Tiles, Wavelet
device = ltcl.open_device()
assert device.max_group == 8
device.kind = "gpu"
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


@pytest.mark.slow
def test_small_work_groups_will_do_in_the_shape_of_a_gpu():
    environment = {
        **os.environ,
        "POCL_MAX_WORK_GROUP_SIZE": "8",
        "PYOPENCL_BUILD_OPTIONS": "-cl-opt-disable",
    }
    subprocess.run([sys.executable, "-c", SMALL_GROUPS], env=environment, check=True, timeout=120)


# Entries of a core, and the coefficients in use; five of eight give the whole basis.
SUPPORTS = [
    ([(7, 1), (2, 2), (7, 3)], [1, 2, 3, 7]),
    ([(7, 1), (2, 2), (7, 3), (0, 0)], range(8)),
    ([], [0]),
]


@pytest.mark.parametrize(("entries", "places"), SUPPORTS)
@pytest.mark.parametrize("kind", ["wavelet", "order", "wavelet and order"])
def test_a_core_is_restricted_to_rows_and_columns_in_use(device, kind, entries, places):
    rows, columns = np.array(entries).reshape(-1, 2).T
    whole = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(8, 8))
    haar = Wavelet(device, (2, 4), "haar")
    bases = {
        "wavelet": haar,
        "order": SubsetBasis(device, (2, 4), some(8, 1)),
        "wavelet and order": SubsetBasis(device, (2, 4), some(8, 1), of=haar),
    }
    W = bases[kind]
    core, V = restrict_to_support(whole, W)
    np.testing.assert_array_equal(V.to_dense(), W.to_dense()[places])
    assert V.grid == (2, 4)
    assert V.isometric
    assert V.orthonormal == (len(places) == 8)
    before = Compressed(CSR(device, whole), W, W)
    restricted = Compressed(CSR(device, core), V, V)
    np.testing.assert_allclose(restricted.to_dense(), before.to_dense(), atol=1e-6)


def test_a_part_of_a_pyramid_is_not_isometric(device):
    core = np.eye(7) * (np.arange(7) < 2)
    assert not restrict_to_support(core, Pyramid(device, (1, 4)))[1].isometric


@pytest.mark.parametrize("grid", [(1, 1), (1, 7), (5, 8), (45, 91)])
@pytest.mark.parametrize("levels", [0, 1, 3, 99])
def test_a_multiresolution_order_goes_from_coarse_to_fine(grid, levels):
    order = multiresolution_order(grid, levels)
    np.testing.assert_array_equal(np.sort(order), np.arange(grid[0] * grid[1]))
    # The level of each coefficient, 0 for the finest.
    level = np.zeros(grid, int)
    h, w = grid
    for split in range(1, levels + 1):
        if max(h, w) > 1:
            h = -(-h // 2)
            w = -(-w // 2)
            level[:h, :w] = split
    assert np.all(np.diff(level.ravel()[order]) <= 0)
