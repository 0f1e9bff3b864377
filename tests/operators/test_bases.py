# SPDX-License-Identifier: BSD-3-Clause
"""Subsets and permutations of pixels and of coefficients, the support of a core, bases from files."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Compressed,
    Pyramid,
    SubsetBasis,
    Wavelet,
    bases,
    basis,
    multiresolution_order,
    restrict_to_support,
)
from ltcl.operators.stored import basis_of
from tests import gallery, reference
from tests.operators import helpers


def some(n: int, share: int = 3) -> np.ndarray:
    """A part of n places, or one, in no order; share 1: all of them."""
    return np.random.default_rng(4).permutation(n)[: max(1, n // share)]


@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("share", [1, 3])
@pytest.mark.parametrize("grid", [(1, 1), (9, 8), (20000, 1)])  # the last has more pixels than items
def test_subsets_meet_their_twin(device, monkeypatch, grid, share, kind):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
    n = grid[0] * grid[1]
    places = some(n, share)
    P = SubsetBasis(device, grid, places)
    if n > 100:
        helpers.same_bits(helpers.product(P, x := gallery.vectors(n, 3)), x[places])
        helpers.same_bits(helpers.product(P.T, x[places])[places], x[places])
        return
    matrix = reference.ordered_gather(places, np.eye(n))
    helpers.meets_twin(P, matrix)
    helpers.meets_twin(P, matrix, transpose=True)
    assert P.nbytes == 4 * (len(places) + n)
    assert (P.isometric, P.orthonormal) == (True, len(places) == n)


@pytest.mark.parametrize(
    ("places", "part"),
    [
        ([], r"\(0,\)"),
        ([[0, 1]], r"\(1, 2\)"),
        ([0.5], "float64"),
        ([0, 4], "0 to 4"),
        ([-1, 2], "-1 to 2"),
        ([1, 1], "1 to 1.*4"),
    ],
)
def test_what_is_no_subset_is_refused(device, places, part):
    with pytest.raises(InputError, match=f"places.*{part}"):
        SubsetBasis(device, (2, 2), places)
    with pytest.raises(InputTypeError):
        SubsetBasis(device, (2, 2), [None])
    for of in (Wavelet(device, (1, 4)), Wavelet(Device(device.description), (2, 2))):
        with pytest.raises(InputError, match="of is"):
            SubsetBasis(device, (2, 2), [1, 2], of=of)


@pytest.mark.parametrize("small", [0, 12, 4096])
@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("grid", [(1, 1), (3, 5), (1, 29), (29, 1), (7, 12)])
def test_pyramids_meet_their_twin(device, monkeypatch, grid, kind, small):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
    monkeypatch.setattr(bases, "_SMALL", small)
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 5, 11))
    W = Pyramid(device, grid)
    helpers.meets_twin(W, reference.pyramid_gather(np.eye(W.shape[1]).reshape(*grid, -1)))
    helpers.meets_twin(W.T, reference.pyramid_spread(grid))


@pytest.mark.parametrize("kind", [Wavelet, Pyramid])
def test_a_picture_takes_four_launches(device, kind):
    W = kind(device, (256, 512))
    for A in (W, W.T):
        x = device.upload(gallery.vectors(A.shape[1], 3))
        before = device.launches.total()
        A.apply(x)
        assert device.launches.total() - before <= 4


def _core(*entries):
    rows, columns = np.array(entries).reshape(-1, 2).T
    return scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(8, 8))


@pytest.mark.parametrize(
    ("entries", "places"),
    [
        ([(7, 1), (2, 2), (7, 3)], [1, 2, 3, 7]),
        ([(7, 1), (2, 2), (7, 3), (0, 0)], range(8)),  # five of eight: the whole basis
        ([], [0]),
    ],
)
def test_a_core_is_restricted_to_rows_and_columns_in_use(device, entries, places):
    wavelet = Wavelet(device, (2, 4), "haar")
    for W in (
        wavelet,
        SubsetBasis(device, (2, 4), some(8, 1)),
        SubsetBasis(device, (2, 4), some(8, 1), of=wavelet),
    ):
        core, V = restrict_to_support(_core(*entries), W)
        np.testing.assert_array_equal(V.to_dense(), W.to_dense()[places])
        assert (V.grid, V.isometric, V.orthonormal) == ((2, 4), True, len(places) == 8)
        np.testing.assert_allclose(
            Compressed(CSR(device, core), V, V).to_dense(),
            Compressed(CSR(device, _core(*entries)), W, W).to_dense(),
            atol=1e-6,
        )
    P = Pyramid(device, (1, 4))
    assert not restrict_to_support(np.eye(7) * (np.arange(7) < 2), P)[1].isometric


@pytest.mark.parametrize("grid", [(1, 1), (1, 7), (5, 8), (45, 91)])
@pytest.mark.parametrize("levels", [0, 1, 3, 99])
def test_a_multiresolution_order_goes_from_coarse_to_fine(grid, levels):
    order = multiresolution_order(grid, levels)
    np.testing.assert_array_equal(np.sort(order), np.arange(grid[0] * grid[1]))
    level = np.zeros(grid, int)  # of each coefficient, 0 the finest
    h, w = grid
    for split in range(1, levels + 1):
        if max(h, w) > 1:
            h, w = -(-h // 2), -(-w // 2)
            level[:h, :w] = split
    assert np.all(np.diff(level.ravel()[order]) <= 0)


def _bases(device):
    wavelet = Wavelet(device, (5, 6), "db2", 2)
    order = SubsetBasis(device, (5, 6), some(30, 1))
    return {
        "db2": wavelet,
        "pyramid": Pyramid(device, (5, 6)),
        "permutation": order,
        "of wavelets": SubsetBasis(device, (5, 6), some(30), of=wavelet),
        "of a permutation": SubsetBasis(
            device, (5, 6), some(30), of=SubsetBasis(device, (5, 6), some(30, 1), of=wavelet)
        ),
    }


@pytest.mark.parametrize("name", ["db2", "pyramid", "permutation", "of wavelets", "of a permutation"])
def test_bases_come_back_from_their_arrays(device, name):
    made, x = _bases(device)[name], gallery.vectors(30, 2)
    arrays = made.to_arrays()
    again = basis_of(device, arrays)
    assert type(again) is type(made)
    assert (again.name, again.grid, again.orthonormal) == (made.name, made.grid, made.orthonormal)
    helpers.same_bits(helpers.product(again, x), helpers.product(made, x))


@pytest.mark.parametrize(
    ("arrays", "part"),
    [
        ({}, "grid and name"),
        ({"name": "db2"}, "grid"),
        ({"name": "pixels", "grid": [2, 2]}, "pixels"),
        ({"name": "haar", "grid": [2, 2], "levels": 9}, "levels is 9"),
        ({"name": "haar", "grid": [2], "levels": 1}, "grid is"),
    ],
)
def test_arrays_that_describe_no_basis_are_refused(device, arrays, part):
    with pytest.raises(InputError, match=part):
        basis_of(device, arrays)


@pytest.mark.parametrize("name", ["hilbert", None, "bior2.2"])
def test_what_names_no_basis_and_bad_grids_are_refused(device, name):
    assert basis(device, (4, 6), "pixels") is None
    for make, part in (
        (lambda: basis(device, (4, 6), name), f"{name}.*haar"),
        (lambda: multiresolution_order((0, 3), 1), r"grid is \(0, 3\)"),
        (lambda: Pyramid(device, (0, 3)), r"grid is \(0, 3\)"),
        (lambda: multiresolution_order((4, 4), 1.5), r"levels is 1\.5"),  # pyright: ignore[reportArgumentType]
    ):
        with pytest.raises(InputError, match=part):
            make()
