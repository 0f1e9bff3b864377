# SPDX-License-Identifier: BSD-3-Clause
"""Sparse matrices in tiles: every variant of every product, what is stored and lost, slabs, refusals."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import CSR, Tiles, smallest
from ltcl.operators.covers import cover
from ltcl.operators.narrow import PRECISIONS, Narrow, narrow
from ltcl.operators.packing import pack, spread
from tests import gallery, reference
from tests.operators import helpers

WIDTHS = (1, 8, 16)
KINDS = [(1, "float16"), (8, "bfloat16"), (16, "int8")]  # each width and each narrow type once
BITS = {"float32": 24, "bfloat16": 8, "float16": 11}


def twin(A: Tiles):
    """The kernels' twin on what lies on the device, read as a file would be."""
    stored = A.to_arrays()
    width, granule, pages, _ = stored["layout"]
    pointers = stored["pointers"]
    page = np.repeat(np.arange(len(pointers) - 1) % pages, np.diff(pointers))
    columns = np.minimum((page * 65536 + stored["starts"]) * granule, A.shape[1] - width)
    values = stored["codes"].astype(np.float64)
    if A.precision == "bfloat16":
        values = np.ldexp(*_bfloat16(stored["codes"].astype(np.int64)))
    if A.precision == "int8":
        bits = stored["scales"].astype(np.int64)
        values = np.ldexp(values * (8 + bits % 8)[:, None], (bits // 8 - 15 - 3)[:, None])
    factors = np.full(A.shape[0], float(stored["unit"]))
    return lambda *operands: reference.tile_matvec(pointers[::pages], columns, values, factors, *operands)


def _bfloat16(bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mantissa and exponent of normal numbers and zeros, by the definition of the format."""
    sign, exponent, fraction = 1 - 2 * (bits >> 15), (bits >> 7) & 0xFF, bits & 0x7F
    return np.where(exponent > 0, sign * (128.0 + fraction), 0.0), exponent - 127 - 7


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize(("width", "precision"), KINDS)
@pytest.mark.parametrize("launch", ["item", "stream", "group7", "group32"])
def test_products_meet_their_twin(device, monkeypatch, name, width, precision, launch):
    monkeypatch.setattr(helpers, "COLUMNS", (None, 3, 9))  # launches of 1, 3 and 8, alone and among others
    A = Tiles(device, gallery.SPARSE[name], width, precision)
    helpers.force(monkeypatch, A, launch)
    helpers.meets_twin(A, A.to_dense(), twin(A))


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_kind_and_its_transpose_is_the_matrix_it_stands_for(device, monkeypatch, width, precision):
    monkeypatch.setattr(helpers, "COLUMNS", (3,))  # the others are built above
    A = Tiles(device, gallery.SPARSE["stretches"], width, precision)
    matrix = A.matrix()
    assert matrix.dtype == np.float64
    helpers.meets_twin(A, matrix.toarray(), twin(A))
    helpers.meets_twin(A, matrix.toarray(), transpose=True)


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_transposes_are_exact_ones_of_the_same_numbers(device, name, precision):
    A = Tiles(device, gallery.SPARSE[name], 8, precision)
    np.testing.assert_array_equal(A.transposed_copy().matrix().T.toarray(), A.to_dense())
    assert A.transposed_copy().precision == ("float16" if precision == "int8" else precision)


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("precision", BITS)
def test_floats_are_rounded_to_nearest(device, name, width, precision):
    matrix = gallery.SPARSE[name].toarray().astype(np.float64)
    found = Tiles(device, gallery.SPARSE[name], width, precision).to_dense()
    step = np.ldexp(1.0, np.frexp(matrix)[1] - BITS[precision])
    np.testing.assert_array_equal(np.abs(found - matrix) <= step / 2, True)
    np.testing.assert_array_equal(np.mod(found, step), 0)


def test_ties_go_to_even():
    ties = scipy.sparse.csr_array([[1 + 2.0**-8, 1 + 3 * 2.0**-8, -1 - 2.0**-8]])
    assert pack(ties, 1, "bfloat16").matrix().toarray().tolist() == [[1, 1 + 2.0**-6, -1]]


@pytest.mark.parametrize("width", WIDTHS)
def test_int8_is_within_half_a_step_of_its_tile(width):
    packed = pack(gallery.SPARSE["stretches"], width, "int8")
    exact = pack(gallery.SPARSE["stretches"], width, "float32").stored.decoded()
    found = packed.stored.decoded()
    step = np.abs(exact).max(axis=1, keepdims=True) / 127 * 1.125  # of 3 bits of fraction, rounded up
    assert np.all(np.abs(found - exact) <= step / 2)
    assert np.abs(packed.stored.codes).max() <= 127


def test_products_of_all_scales_and_codes_are_exact_in_float16():
    bits = np.arange(8, 23 * 8, dtype=np.uint8)  # numbers end below 2^15
    codes = np.broadcast_to(np.arange(-127, 128, dtype=np.int8), (len(bits), 255))
    numbers = Narrow("int8", codes, bits, 1.0).decoded()
    again = narrow(numbers, "float16", 1.0).decoded()
    np.testing.assert_array_equal(numbers[np.abs(numbers) < 2.0**15], again[np.abs(numbers) < 2.0**15])


@pytest.mark.parametrize("exponent", [-149, -126, -60, 0, 60, 127])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_sizes_of_float32_neither_overflow_nor_vanish(device, exponent, precision):
    a = np.ldexp(1 - 2.0**-24, exponent + 1) if exponent > -126 else np.ldexp(1.0, exponent)
    A = Tiles(device, scipy.sparse.csr_array([[a, a / 2]]), 1, precision)
    least = 2.0**-119 if precision == "int8" else 2.0**-149  # below, a row has no scale in float32
    assert np.allclose(A.to_dense(), [[a, a / 2]], rtol=0.01, atol=least)
    if exponent > -100:  # devices may flush what is smaller
        assert A @ np.array([0.5, 0.0]) == pytest.approx([a / 2], rel=0.01)


@pytest.mark.parametrize("name", gallery.SPARSE)
@pytest.mark.parametrize("precision", PRECISIONS)
def test_what_is_lost_is_known(device, name, precision):
    given = gallery.SPARSE[name].astype(np.float64) * np.pi
    A = Tiles(device, given, 8, precision)
    lost = given.toarray() - A.to_dense()
    assert A.quantisation == pytest.approx(np.linalg.norm(lost), rel=1e-12)
    spectral = np.linalg.norm(lost, 2)
    bound = min(np.linalg.norm(lost), np.sqrt(np.linalg.norm(lost, 1) * np.linalg.norm(lost, np.inf)))
    assert spectral * (1 - 1e-12) <= A.error == pytest.approx(bound, rel=1e-12)
    assert A.T.error == A.error


def test_tiles_are_the_fewest():
    rng = np.random.default_rng(5)
    for columns, width in itertools.product((1, 7, 8, 17, 23), WIDTHS):
        pattern = scipy.sparse.csr_array((rng.random((40, columns)) < 0.3).astype(np.float32))
        found = cover(pattern, width)
        wide = found.layout.width
        assert wide <= max(columns, 1)
        assert np.all((found.columns >= 0) & (found.columns <= columns - wide))
        counts = np.bincount(found.rows, minlength=40)
        for row in range(40):
            assert counts[row] == _fewest(pattern[[row]].indices.tolist(), wide)


def _fewest(places: list[int], width: int) -> int:
    """Least number of stretches that cover the places, by trying every first stretch."""
    if not places:
        return 0
    firsts = range(places[0] - width + 1, places[0] + 1)
    return 1 + min(_fewest([p for p in places if p >= first + width], width) for first in firsts[-2:])


@pytest.mark.parametrize(
    ("columns", "width", "layout"),
    [
        (65536, 1, (1, 1, 1, 0)),
        (65537, 1, (1, 1, 2, 0)),
        (65537, 8, (8, 2, 1, 0)),
        (8 * 65536, 8, (8, 8, 1, 0)),
        (16 * 65536 + 3, 16, (16, 16, 2, 0)),
        (9 * 65536, 1, (1, 1, 1, 1)),
    ],
)
def test_places_of_wide_matrices_stay_short_where_that_pays(device, columns, width, layout):
    rng = np.random.default_rng(columns)
    counts = (0, 1, 9, 12, 5)
    places = [np.sort(rng.choice(columns, count, replace=False)) for count in counts]
    places[3] = np.append(places[3][:-3], [columns - 20, columns - 2, columns - 1])
    indices, data = np.concatenate(places), rng.standard_normal(sum(counts)).astype(np.float32)
    given = scipy.sparse.csr_array((data, indices, np.cumsum([0, *counts])), (len(counts), columns))
    A = Tiles(device, given, width, "float32")
    assert tuple(A.to_arrays()["layout"]) == layout
    assert abs(A.matrix() - given).nnz == 0
    x = rng.standard_normal((columns, 3)).astype(np.float32)
    assert np.all(np.abs(A @ x - given.astype(np.float64) @ x) <= 1e-5 * (abs(given) @ np.abs(x)))
    y = rng.standard_normal((len(counts), 3)).astype(np.float32)
    assert np.all(np.abs(A.T @ y - given.T.astype(np.float64) @ y) <= 1e-5 * (abs(given.T) @ np.abs(y)))


@pytest.mark.parametrize(("width", "precision"), KINDS)
def test_slabs_give_the_same_as_one_buffer(device, small_device, width, precision):
    matrix = gallery.SPARSE["129x129"] + gallery.SPARSE["129x129"].T
    whole, cut = Tiles(device, matrix, width, precision), Tiles(small_device, matrix, width, precision)
    assert len(cut.slabs) > len(whole.slabs) == 1
    for k in (None, 3):
        x = gallery.vectors(129, k)
        one, many = (A.apply(A.device.upload(x)).get() for A in (whole, cut))
        helpers.same_rows(device, one, many, reference.product_error(whole.to_dense(), x))


@pytest.mark.parametrize(("width", "precision"), KINDS)
def test_stored_arrays_make_the_same_again(device, width, precision):
    A = Tiles(device, gallery.SPARSE["stretches"], width, precision)
    B = Tiles.from_arrays(device, {name: np.array(array) for name, array in A.to_arrays().items()})
    assert (A.quantisation, A.error, A.nbytes) == (B.quantisation, B.error, B.nbytes)
    assert all(np.array_equal(B.to_arrays()[name], array) for name, array in A.to_arrays().items())
    x = gallery.vectors(97, 3)
    helpers.same_bits(A._matmat(x), B._matmat(x))
    helpers.same_bits(A._rmatmat(x[:24]), B._rmatmat(x[:24]))


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
        ("layout", lambda a: a * 2),
    ],
)
def test_stored_arrays_that_do_not_fit_are_refused(device, name, spoil):
    arrays = Tiles(device, gallery.SPARSE["stretches"], 8, "int8").to_arrays()
    with pytest.raises(InputError, match="must"):
        Tiles.from_arrays(device, {**arrays, name: spoil(arrays[name])})


def test_stored_arrays_that_lack_one_are_refused(device):
    arrays = Tiles(device, gallery.SPARSE["53x7"]).to_arrays()
    for name in arrays:
        with pytest.raises(InputError, match=f"lack {name}"):
            Tiles.from_arrays(device, {other: array for other, array in arrays.items() if other != name})


def test_zeros_that_are_stored_claim_no_tiles():
    matrix = scipy.sparse.csr_array(np.ones((2, 40)))
    matrix.data[1:] = 0
    assert len(pack(matrix, 8).starts) == 1
    assert matrix.nnz == 80  # the user's matrix is left alone


def test_bytes_are_those_of_the_buffers(device, small_device):
    A = Tiles(device, gallery.SPARSE["stretches"], 8, "int8")
    tiles = len(A.packed.starts)
    assert A.nbytes == tiles * (8 + 1 + 2) + 4 * 25
    A.apply_transpose(device.upload(np.ones(24)))
    assert A.nbytes == tiles * (8 + 1 + 2) + 4 * 25 + A.transposed_copy().nbytes
    cut = Tiles(small_device, gallery.SPARSE["129x129"], 1, "float32")
    buffers = {id(a): a.nbytes for slab in cut.slabs for a in slab.arguments if not isinstance(a, int)}
    assert cut.nbytes == sum(buffers.values())


@pytest.mark.parametrize("name", gallery.SPARSE)
def test_facts_about_the_entries(device, name):
    A = Tiles(device, gallery.SPARSE[name], 8, "bfloat16")
    matrix = A.matrix().toarray()
    np.testing.assert_array_equal(A.diagonal(), matrix.diagonal())
    np.testing.assert_array_equal(A.to_dense(), matrix)
    helpers.norms_match(A, matrix, rel=1e-12)
    half = A.shape[0] // 2
    (part,) = A.parts([(slice(0, half), slice(1, None))])
    np.testing.assert_array_equal(part, matrix[:half, 1:])


def test_a_dense_array_is_taken(device):
    A = Tiles(device, gallery.signed(5, 20), 16, "float32")
    np.testing.assert_array_equal(A.to_dense(), gallery.signed(5, 20))


def test_the_smallest_that_is_good_enough_is_named(device):
    runs = gallery.SPARSE["stretches"]
    scattered = scipy.sparse.csr_array(np.where(np.arange(53 * 530).reshape(53, -1) % 31 == 0, 0.3, 0.0))
    for matrix, tolerance in itertools.product((runs, scattered), (0.1, 0.003, 3e-4, 0)):
        norm = scipy.sparse.linalg.norm(matrix.astype(np.float64))
        made = [
            Tiles(device, matrix, width, precision)
            for width, precision in itertools.product(WIDTHS, PRECISIONS)
        ]
        good = [A for A in made if A.quantisation <= tolerance * norm or A.precision == "float32"]
        chosen = Tiles(device, matrix, *smallest(matrix, tolerance))
        assert chosen.packed.nbytes == min(A.packed.nbytes for A in good)
    assert smallest(scattered, 0.1)[0] == 1
    assert smallest(runs, 0.1)[0] > 1


@pytest.mark.parametrize("width", WIDTHS)
def test_what_lies_in_kept_tiles_is_kept(width):
    matrix = gallery.SPARSE["stretches"]
    kept = scipy.sparse.csr_array(matrix * (abs(matrix) > 0.9))
    found = spread(kept, matrix, width)
    assert len(cover(found, width).rows) == len(cover(kept, width).rows)
    some, all_of, given = kept.toarray(), found.toarray(), matrix.toarray()
    np.testing.assert_array_equal(all_of[some != 0], some[some != 0])
    np.testing.assert_array_equal(all_of[all_of != 0], given[all_of != 0])
    assert found.nnz > kept.nnz or width == 1
    with pytest.raises(InputError, match="kept has shape"):
        spread(kept, matrix.T, width)


def test_memory_is_asked_before_anything_is_allocated(device, monkeypatch):
    monkeypatch.setattr(device, "memory", 100)
    monkeypatch.setattr(Device, "empty", lambda *_: pytest.fail("allocated"))
    with pytest.raises(MemoryLimitError, match=r"needs .* but .* has 100 B"):
        Tiles(device, gallery.SPARSE["53x7"])


def test_row_beyond_the_largest_buffer_is_refused_with_both_sizes(small_device):
    with pytest.raises(MemoryLimitError, match=r"row 1 of the matrix of tiles has 4 KiB"):
        Tiles(small_device, scipy.sparse.csr_array([np.zeros(1024), np.ones(1024)]), 8, "float32")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((gallery.SPARSE["53x7"], 4), "width is 4; it must be one of 1, 8, 16"),
        ((gallery.SPARSE["53x7"], 8, "double"), "precision is 'double'; it must be one of float32"),
        ((np.ones(3),), r"matrix has shape \(3,\); it must be \(M, N\)"),
        ((scipy.sparse.csr_array([[np.nan]]),), "matrix.data has 1 NaN"),
        ((np.array([[1.0, np.inf]]),), "matrix has 1 NaN or infinite"),
        ((scipy.sparse.csr_array([[1e39]]),), "beyond float32"),
    ],
)
def test_bad_input_is_refused(device, arguments, message):
    with pytest.raises(InputError, match=message):
        Tiles(device, *arguments)


def test_what_is_not_a_matrix_is_refused(device):
    with pytest.raises(InputTypeError, match="matrix holds"):
        Tiles(device, np.array([["a"]]))
    with pytest.raises(InputError, match="tolerance is -1"):
        smallest(gallery.SPARSE["53x7"], -1)


def test_a_sparse_operator_of_the_same_numbers_takes_sweeps(device):
    A = Tiles(device, gallery.sparse(53, 53), 8, "bfloat16")
    np.testing.assert_array_equal(CSR(device, A.matrix()).to_dense(), A.to_dense())
