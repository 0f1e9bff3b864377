# SPDX-License-Identifier: BSD-3-Clause
"""Subsets and permutations of pixels, bases one after another, bases by name and from files."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Chained,
    Compressed,
    Pyramid,
    SubsetBasis,
    Wavelet,
    basis,
    multiresolution_order,
    restrict_to_support,
)
from ltcl.operators.bases import restrict, support
from ltcl.operators.stored import basis_of
from tests import gallery, reference
from tests.operators import helpers

GRIDS = ((1, 1), (3, 5), (1, 70), (9, 8))
LONG = 20000  # more pixels than there are items


def some(n: int, share: int = 3) -> np.ndarray:
    """A part of n places, or one, in no order; share 1: all of them."""
    return np.random.default_rng(4).permutation(n)[: max(1, n // share)]


@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("share", [1, 3])
@pytest.mark.parametrize("grid", GRIDS)
def test_subsets_meet_their_twin(device, monkeypatch, grid, share, kind):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
    n = grid[0] * grid[1]
    places = some(n, share)
    P = SubsetBasis(device, grid, places)
    matrix = np.eye(n)[places]
    helpers.meets_twin(P, matrix, lambda *arguments: reference.ordered_gather(places, *arguments))
    helpers.meets_twin(
        P, matrix, lambda *arguments: reference.ordered_scatter(places, n, *arguments), transpose=True
    )
    np.testing.assert_array_equal(P.diagonal(), matrix.diagonal())
    assert P.nbytes == 4 * (len(places) + n)
    assert P.isometric
    assert P.orthonormal == (len(places) == n)


def test_permutations_lose_no_bit(device):
    x = gallery.vectors(LONG, 3)
    W = SubsetBasis(device, (LONG, 1), some(LONG, 1))
    a = helpers.product(W, x)
    helpers.same_bits(a, x[W.places])
    helpers.same_bits(helpers.product(W.T, a), x)


@pytest.mark.parametrize(
    ("places", "part"),
    [
        ([], r"has shape \(0,\)"),
        ([[0, 1]], r"has shape \(1, 2\)"),
        ([0.5], "float64"),
        ([0, 4], "from 0 to 4"),
        ([-1, 2], "from -1 to 2"),
        ([1, 1], "twice"),
    ],
)
def test_what_is_no_subset_is_refused(device, places, part):
    with pytest.raises(InputError, match=f"places.*{part}"):
        SubsetBasis(device, (2, 2), places)
    with pytest.raises(InputTypeError):
        SubsetBasis(device, (2, 2), [None])


def test_a_restricted_basis_has_some_rows_of_the_basis(device):
    W = Wavelet(device, (5, 6), "db2")
    order, places = some(30, 1), some(30)
    for whole in (
        W,
        SubsetBasis(device, (5, 6), order),
        Chained(SubsetBasis(device, (5, 6), order), W),
    ):
        V = restrict(whole, places)
        np.testing.assert_array_equal(V.to_dense(), whole.to_dense()[places])
        assert (V.grid, V.shape, V.isometric, V.orthonormal) == ((5, 6), (10, 30), True, False)
        again = basis_of(device, V.to_arrays())
        x = gallery.vectors(30, 3)
        helpers.same_bits(helpers.product(again, x), helpers.product(V, x))
        assert (again.isometric, again.orthonormal) == (True, False)
    assert not restrict(Pyramid(device, (5, 6)), places).isometric


def _core(*entries):
    rows, columns = np.array(entries).reshape(-1, 2).T
    return scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(8, 8))


@pytest.mark.parametrize(
    ("entries", "places"),
    [
        ([(7, 1), (2, 2), (7, 3)], [1, 2, 3, 7]),
        ([(7, 1), (2, 2), (7, 3), (0, 0)], None),  # five of eight
        ([], [0]),
    ],
)
def test_the_support_are_rows_and_columns_in_use(device, entries, places):
    found = support(_core(*entries))
    assert (None if found is None else found.tolist()) == places
    W = Wavelet(device, (2, 4), "haar")
    core, V = restrict_to_support(_core(*entries), W)
    assert V.shape[0] == (8 if places is None else len(places))
    np.testing.assert_allclose(
        Compressed(CSR(device, core), V, V).to_dense(),
        Compressed(CSR(device, _core(*entries)), W, W).to_dense(),
        atol=1e-6,
    )


@pytest.mark.parametrize("grid", [(1, 1), (1, 7), (6, 1), (5, 8), (16, 32), (45, 91)])
@pytest.mark.parametrize("levels", [0, 1, 3, 99])
def test_a_multiresolution_order_goes_from_coarse_to_fine(grid, levels):
    order = multiresolution_order(grid, levels)
    np.testing.assert_array_equal(np.sort(order), np.arange(grid[0] * grid[1]))
    assert np.all(np.diff(_levels(grid, levels)[order]) <= 0)


def test_the_details_of_a_place_stand_together_and_places_are_neighbours():
    h, w = 16, 16
    order = multiresolution_order((h, w), 2)
    y, x = np.divmod(order[-3 * (h // 2) * (w // 2) :], w)  # the finest level
    places = np.stack([y % (h // 2), x % (w // 2)], axis=1).reshape(-1, 3, 2)
    assert np.all(places == places[:, :1])
    assert np.all(np.abs(np.diff(places[:, 0], axis=0)).sum(axis=1) == 1)  # Hilbert's curve


def _levels(grid: tuple[int, int], levels: int) -> np.ndarray:
    """Level of each coefficient, (N,): 0 is the finest, `levels` the approximation."""
    found = np.zeros(grid, int)
    h, w = grid
    for level in range(1, levels + 1):
        if max(h, w) > 1:
            h, w = -(-h // 2), -(-w // 2)
            found[:h, :w] = level
    return found.ravel()


def test_bases_are_called_by_name(device):
    assert basis(device, (4, 6), "pixels") is None
    for name, kind in (("haar", Wavelet), ("db2", Wavelet), ("db4", Wavelet), ("pyramid", Pyramid)):
        W = basis(device, (4, 6), name)
        assert isinstance(W, kind)
        assert (W.name, W.grid) == (name, (4, 6))


def test_what_does_not_fit_is_refused(device):
    for make, part in (
        (lambda: Chained(Wavelet(device, (5, 6)), Pyramid(device, (5, 6))), r"outer.* 30 .* 44 "),
        (lambda: Chained(Wavelet(device, (5, 6)), Wavelet(Device(device.description), (5, 6))), "outer"),
        (lambda: multiresolution_order((0, 3), 1), "grid is"),
        (lambda: multiresolution_order((4, 4), 1.5), "levels is"),  # pyright: ignore[reportArgumentType]
    ):
        with pytest.raises(InputError, match=part):
            make()


@pytest.mark.parametrize("name", ["peano", "hilbert", None, "bior2.2"])
def test_other_names_are_refused(device, name):
    with pytest.raises(InputError, match=f"{name}.*haar"):
        basis(device, (4, 6), name)


def _made(device):
    order = SubsetBasis(device, (5, 6), some(30, 1), "mine")
    return {
        "db2": Wavelet(device, (5, 6), "db2", 2),
        "pyramid": Pyramid(device, (5, 6)),
        "permutation": order,
        "chained": Chained(order, Chained(order, Wavelet(device, (5, 6), "haar"))),
    }


@pytest.mark.parametrize("name", ["db2", "pyramid", "permutation", "chained"])
def test_bases_come_back_from_their_arrays(device, tmp_path, name):
    made = _made(device)[name]
    np.savez(tmp_path / "basis.npz", **made.to_arrays())
    with np.load(tmp_path / "basis.npz", allow_pickle=False) as arrays:
        found = basis_of(device, dict(arrays))
    assert type(found) is type(made)
    assert (found.name, found.grid, found.orthonormal) == (made.name, made.grid, made.orthonormal)
    x = gallery.vectors(30, 2)
    helpers.same_bits(helpers.product(found, x), helpers.product(made, x))


def test_permutations_of_files_that_call_them_orders_are_read(device):
    order = some(30, 1)
    found = basis_of(device, {"name": np.array("hilbert"), "grid": np.array([5, 6]), "order": order})
    np.testing.assert_array_equal(found.to_dense(), np.eye(30)[order])


@pytest.mark.parametrize(
    ("arrays", "part"),
    [
        ({}, "grid and name"),
        ({"name": "db2"}, "grid"),
        ({"name": "pixels", "grid": [2, 2]}, "pixels"),
        ({"name": "haar", "grid": [2, 2], "levels": 9}, "levels is 9"),
        ({"name": "haar", "grid": [2], "levels": 1}, "grid is"),
        ({"outer.name": "haar"}, "grid"),
    ],
)
def test_arrays_that_describe_no_basis_are_refused(device, arrays, part):
    with pytest.raises(InputError, match=part):
        basis_of(device, arrays)
