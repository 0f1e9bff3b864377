# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices in tiles: packing, rounding, refusals."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError
from ltcl.operators import Tiles, smallest
from ltcl.operators.tiles import PRECISIONS, pack
from tests import gallery, reference
from tests.operators import helpers

WIDTHS = (1, 8)


def decoded(A: Tiles) -> np.ndarray:
    """The matrix that lies on the device, read as a file would be."""
    stored = A.to_arrays()
    values = stored["codes"].astype(np.float64)
    if A.precision == "int8":
        bits = stored["scales"].astype(np.int64)
        values = np.ldexp(values * (8 + bits % 8)[:, None], (bits // 8 - 15 - 3)[:, None])
    columns = stored["starts"].astype(np.int64)
    numbers = values * float(stored["unit"])
    return reference.tile_matvec(stored["pointers"], columns, numbers, np.eye(A.shape[1]))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", gallery.SPARSE)
def test_every_kind_and_its_transpose_is_what_it_stands_for(
    device, monkeypatch, name, width, precision
):
    # Others are in test_rows.py.
    monkeypatch.setattr(helpers, "COLUMNS", (3,))
    A = Tiles(device, gallery.SPARSE[name], width, precision)
    assert A.matrix().dtype == np.float64
    helpers.meets_twin(A, decoded(A))
    np.testing.assert_array_equal(A.to_dense(), decoded(A))
    transposed = A.transposed_copy()
    assert isinstance(transposed, Tiles)
    np.testing.assert_array_equal(transposed.to_dense().T, A.to_dense())
    assert transposed.precision == ("float16" if precision == "int8" else precision)


@pytest.mark.parametrize("name", ["53x7", "stretches", "all empty"])
@pytest.mark.parametrize("width", WIDTHS)
def test_values_are_rounded_to_nearest(name, width):
    exact = pack(gallery.SPARSE[name], width, "float32").decoded()
    np.testing.assert_array_equal(exact[exact != 0], gallery.SPARSE[name].data.astype(np.float64))
    half = pack(gallery.SPARSE[name], width, "float16").decoded()
    step = np.ldexp(1.0, np.frexp(exact)[1] - 11)
    np.testing.assert_array_equal(np.abs(half - exact) <= step / 2, True)
    np.testing.assert_array_equal(np.mod(half, step), 0)
    packed = pack(gallery.SPARSE[name], width, "int8")
    # Scales have 3 bits of fraction, rounded up.
    step = np.abs(exact).max(axis=1, keepdims=True) / 127 * 1.125
    assert np.all(np.abs(packed.decoded() - exact) <= step / 2)
    assert np.abs(packed.codes).max(initial=0) <= 127


@pytest.mark.parametrize("exponent", [-149, -126, -60, 0, 60, 127])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_sizes_of_float32_neither_overflow_nor_vanish(device, exponent, precision):
    a = np.ldexp(1 - 2.0**-24, exponent + 1) if exponent > -126 else np.ldexp(1.0, exponent)
    A = Tiles(device, scipy.sparse.csr_array([[a, a / 2]]), 1, precision)
    # Smaller numbers have no scale in float32.
    smallest_number = 2.0**-119 if precision == "int8" else 2.0**-149
    assert np.allclose(A.to_dense(), [[a, a / 2]], rtol=0.01, atol=smallest_number)
    # Devices may flush smaller numbers.
    if exponent > -100:
        assert A @ np.array([0.5, 0.0]) == pytest.approx([a / 2], rel=0.01)


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_what_is_lost_is_known(device, name, precision):
    given = gallery.SPARSE[name].astype(np.float64) * np.pi
    A = Tiles(device, given, 8, precision)
    lost = given.toarray() - A.to_dense()
    assert A.quantisation == pytest.approx(np.linalg.norm(lost), rel=1e-12)
    spectral = np.linalg.norm(lost, 2)
    product_bound = np.sqrt(np.linalg.norm(lost, 1) * np.linalg.norm(lost, np.inf))
    bound = min(np.linalg.norm(lost), product_bound)
    assert spectral * (1 - 1e-12) <= A.error
    assert A.error == pytest.approx(bound, rel=1e-12)
    assert A.T.error == A.error


def test_tiles_are_the_fewest():
    zeros = scipy.sparse.csr_array(np.ones((2, 40)))
    zeros.data[1:] = 0
    # Stored zeros claim no tile.
    assert len(pack(zeros, 8).columns) == 1
    rng = np.random.default_rng(5)
    for columns, width in itertools.product((1, 7, 8, 17, 23), WIDTHS):
        pattern = scipy.sparse.csr_array((rng.random((40, columns)) < 0.3).astype(np.float32))
        packed = pack(pattern, width, "float32")
        assert packed.width == (width if columns >= width else 1)
        assert packed.columns.max(initial=0) <= columns - packed.width
        for row, count in enumerate(np.diff(packed.pointers)):
            assert count == _fewest(pattern[[row]].indices.tolist(), packed.width)


def _fewest(places: list[int], width: int) -> int:
    """Least number of stretches that cover the places, by trying every first stretch."""
    if not places:
        return 0
    counts = []
    # The last two stretches that hold the first place.
    firsts = range(places[0] - width + 1, places[0] + 1)
    for first in firsts[-2:]:
        left = [place for place in places if place >= first + width]
        counts.append(_fewest(left, width))
    return 1 + min(counts)


@pytest.mark.slow
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize(("columns", "itemsize"), [(65536, 2), (65537, 4)])
def test_column_indices_of_wide_matrices_are_long(device, monkeypatch, columns, itemsize, width):
    places = np.random.default_rng(columns).choice(columns, 27, replace=False)
    places[:3] = columns - np.array([20, 2, 1])
    entries = (gallery.vectors(27, None), (np.minimum(np.arange(27) // 5, 3), places))
    matrix = scipy.sparse.csr_array(entries, shape=(5, columns))
    A = Tiles(device, matrix, width, "float32")
    assert A.to_arrays()["starts"].itemsize == itemsize
    assert abs(A.matrix() - matrix).nnz == 0
    monkeypatch.setattr(helpers, "COLUMNS", (3,))
    helpers.meets_twin(A, matrix.toarray())
    helpers.meets_twin(A, matrix.toarray(), transpose=True)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("pointers", lambda a: a + (np.arange(len(a)) == 3) * 1000),
        ("pointers", lambda a: a[:-1]),
        ("pointers", lambda a: a + 1),
        ("starts", lambda a: a.astype(np.int64)),
        ("starts", lambda a: a[:-1]),
        ("starts", lambda a: a + np.uint16(90)),
        ("codes", lambda a: a[:, :-1]),
        ("codes", lambda a: a.astype(np.float32)),
        ("scales", lambda a: a[:-1]),
        ("scales", lambda a: a.astype(np.float32)),
        ("precision", lambda a: np.array("int9")),
        ("precision", lambda a: np.array("float16")),
        ("unit", lambda a: a * np.nan),
        ("difference", lambda a: a + np.inf),
        ("layout", lambda a: a * [4, 1, 1, 1]),
        # Layouts and numbers that no kernel reads.
        ("layout", lambda a: np.array([16, 1, 1, 0])),
        ("layout", lambda a: np.array([8, 1, 2, 0])),
        ("precision", lambda a: np.array("bfloat16")),
    ],
)
def test_stored_arrays_that_do_not_fit_are_refused(device, name, spoil):
    arrays = Tiles(device, gallery.SPARSE["stretches"], 8, "int8").to_arrays()
    with pytest.raises(InputError, match="must"):
        Tiles.from_arrays(device, {**arrays, name: spoil(arrays[name])})


def test_the_smallest_that_is_good_enough_is_named(device):
    runs = gallery.SPARSE["stretches"]
    is_filled = np.arange(53 * 530).reshape(53, -1) % 31 == 0
    scattered = scipy.sparse.csr_array(np.where(is_filled, 0.3, 0.0))
    for matrix, tolerance in itertools.product((runs, scattered), (0.1, 0.003, 3e-4, 0)):
        norm = scipy.sparse.linalg.norm(matrix.astype(np.float64))
        sizes = []
        for width, precision in itertools.product(WIDTHS, PRECISIONS):
            A = Tiles(device, matrix, width, precision)
            if A.quantisation <= tolerance * norm or precision == "float32":
                sizes.append(A.packed.nbytes)
        assert smallest(matrix, tolerance).nbytes == min(sizes)
    assert smallest(scattered, 0.1).width == 1
    assert smallest(runs, 0.1).width > 1
