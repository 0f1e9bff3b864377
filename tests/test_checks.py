# SPDX-License-Identifier: BSD-3-Clause
"""Refusals name the argument, what it was and what it must be, in one line."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, LtclError, MemoryLimitError
from tests import gallery


def csr(indptr, indices, data, shape):
    """A csr_array as it stands, with nothing checked: as read from a spoilt file."""
    matrix = scipy.sparse.csr_array(shape)
    matrix.indptr, matrix.indices, matrix.data = np.asarray(indptr), np.asarray(indices), np.asarray(data)
    return matrix


GOOD = ([0, 1, 3], [0, 0, 2], [1.0, 2.0, 3.0], (2, 3))

REFUSED = {
    "nan": (
        lambda: checks.finite("b", np.array([0, np.nan])),
        "b has 1 NaN or infinite value(s), the first at 1;",
    ),
    "inf": (
        lambda: checks.finite("b", np.array([[0, np.inf], [-np.inf, 0]])),
        "b has 2 NaN .* the first at (0, 1)",
    ),
    "shape": (
        lambda: checks.shape("b", np.zeros(3), (4,), (4, 2)),
        "b has shape (3,); it must be (4,) or (4, 2)",
    ),
    "grid of three": (
        lambda: checks.grid("grid", (1, 2, 3)),
        "grid is (1, 2, 3); it must be two positive integers",
    ),
    "grid of a number": (lambda: checks.grid("grid", 7), "grid is 7; it must be two"),
    "grid of halves": (lambda: checks.grid("grid", (2.5, 2)), "grid is (2.5, 2); it must be"),
    "grid of text": (lambda: checks.grid("grid", "44"), "grid is '44'; it must be"),
    "infinite grid": (lambda: checks.grid("grid", (np.inf, 1)), "it must be two positive integers"),
    "nan grid": (lambda: checks.grid("grid", (np.nan, 1)), "it must be two positive integers"),
    "empty grid": (lambda: checks.grid("grid", (0, 4)), "grid is (0, 4); it must be"),
    "grid of others": (
        lambda: checks.grid("grid", (2, 3), 5),
        "grid is 2 x 3 = 6 pixels, but the matrix is for 5",
    ),
    "number below": (
        lambda: checks.number("rtol", 0.0, above=0),
        "rtol is 0.0; it must be a finite number above 0",
    ),
    "number beyond": (
        lambda: checks.number("m", 1.5, least=0, most=1),
        "m is 1.5; it must be a finite number at least 0 and at most 1",
    ),
    "number at the edge": (
        lambda: checks.number("m", 1, below=1),
        "m is 1; it must be a finite number below 1",
    ),
    "number of nothing": (lambda: checks.number("m", None), "m is None; it must be a finite number"),
    "number of text": (lambda: checks.number("m", "1"), "m is '1'; it must be a finite number"),
    "number of truth": (lambda: checks.number("m", True), "m is True; it must be a finite number"),
    "not a number": (lambda: checks.number("m", np.nan), "m is nan; it must be a finite number"),
    "infinite number": (
        lambda: checks.number("m", np.inf, above=0),
        "m is inf; it must be a finite number above 0",
    ),
    "count": (lambda: checks.count("k", 0), "k is 0; it must be a whole number of at least 1"),
    "count of a float": (lambda: checks.count("k", 2.0), "k is 2.0; it must be a whole number"),
    "count of truth": (lambda: checks.count("k", True), "k is True; it must be a whole number"),
    "name": (
        lambda: checks.one_of("method", "magic", ["jacobi", "cg"]),
        "method is 'magic'; it must be one of jacobi, cg",
    ),
    "channels": (lambda: checks.colours("channels", 2), "channels is 2; it must be 1 or 3"),
    "sparse vector": (
        lambda: checks.csr("T", scipy.sparse.coo_array([1.0, 2.0])),
        "T has shape (2,); it must be (M, N)",
    ),
    "sparse nan": (lambda: checks.csr("T", csr(*GOOD[:2], [1, np.nan, 3], (2, 3))), "T.data has 1 NaN"),
    "coo nan": (lambda: checks.csr("T", scipy.sparse.coo_array([[np.nan]])), "T.data has 1 NaN"),
    "column beyond": (
        lambda: checks.csr("T", csr([0, 1, 3], [0, 0, 3], *GOOD[2:])),
        "T.indices holds 3; .* 0..2",
    ),
    "negative column": (lambda: checks.csr("T", csr([0, 1, 3], [0, -1, 2], *GOOD[2:])), "T.indices holds -1"),
    "row of csc beyond": (
        lambda: checks.csr("T", csr([0, 1, 3], [0, 0, 3], *GOOD[2:]).T),
        "T.indices holds 3; column indices must be in 0..2",
    ),
    "falling pointers": (lambda: checks.csr("T", csr([0, 3, 2], *GOOD[1:])), "T.indptr falls after entry 1"),
    "few pointers": (
        lambda: checks.csr("T", csr([0, 3], *GOOD[1:])),
        "T.indptr has 2 entries from 0; it must have 3",
    ),
    "late pointers": (lambda: checks.csr("T", csr([1, 2, 3], *GOOD[1:])), "T.indptr has 3 entries from 1"),
    "no pointers": (
        lambda: checks.csr("T", csr(np.zeros(0, int), *GOOD[1:])),
        "T.indptr has 0 entries from none",
    ),
    "short indices": (
        lambda: checks.csr("T", csr([0, 1, 3], [0, 1], *GOOD[2:])),
        "ends at 3 with 2 indices and 3 values",
    ),
    "short values": (
        lambda: checks.csr("T", csr(*GOOD[:2], [1.0], (2, 3))),
        "ends at 3 with 3 indices and 1 values",
    ),
    "float pointers": (
        lambda: checks.csr("T", csr([0.0, 1, 3], *GOOD[1:])),
        "T.indptr must be a vector of integers",
    ),
    "square values": (
        lambda: checks.csr("T", csr(*GOOD[:2], [[1.0], [2], [3]], (2, 3))),
        "T.data has shape (3, 1)",
    ),
}

WRONG_TYPES = {
    "masked array": (
        lambda: checks.real("desired", np.ma.masked_greater(np.arange(4.0), 2)),
        "desired is a masked array with 1 masked",
    ),
    "text": (lambda: checks.real("b", ["a"]), "b holds <U1; it must hold real numbers"),
    "complex": (lambda: checks.real("b", [1j]), "b holds complex128"),
    "object": (lambda: checks.real("b", [None]), "b holds object"),
    "complex sparse": (lambda: checks.csr("T", scipy.sparse.coo_array([[1j]])), "T holds complex128"),
    "array for sparse": (lambda: checks.csr("T", np.eye(2)), "T is a ndarray; it must be a scipy.sparse"),
}


def refusal(kind: type[LtclError], act, part: str) -> None:
    with pytest.raises(kind) as error:
        act()
    text = str(error.value)
    assert all(piece in text for piece in part.split(" .* ")), text
    assert "\n" not in text


@pytest.mark.parametrize("name", REFUSED)
def test_bad_values(name):
    refusal(InputError, *REFUSED[name])


@pytest.mark.parametrize("name", WRONG_TYPES)
def test_bad_types(name):
    refusal(InputTypeError, *WRONG_TYPES[name])


def test_good_values_are_handed_on():
    array = np.array([1.0, -2.0])
    assert checks.finite("b", array) is array
    assert checks.real("b", array) is array
    assert checks.shape("b", array, (3,), (2,)) is array
    assert checks.grid("grid", np.array([2, 3]), 6) == checks.grid("grid", [2.0, 3.0]) == (2, 3)
    assert checks.number("m", np.float32(0.5), above=0, below=1) == 0.5
    assert checks.number("m", 1, least=1, most=1) == 1.0
    assert checks.count("k", np.int64(3)) == 3
    assert checks.one_of("method", "cg", ["jacobi", "cg"]) == "cg"


@pytest.mark.parametrize(
    "array",
    [np.full(4, 1e308), np.array([3e38, 3e38], np.float32), np.zeros(0), np.arange(3), np.ones(2, bool)],
)
def test_finite_numbers_pass_even_where_their_sum_does_not(array):
    assert checks.finite("b", array) is array


@pytest.mark.parametrize("form", ["csr", "csc", "coo", "lil", "dok", "bsr", "dia"])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int8", "bool"])
def test_every_sparse_format_becomes_a_canonical_csr_array(form, dtype):
    dense = (gallery.sparse(5, 7).toarray() * 100).astype(dtype)
    matrix = scipy.sparse.coo_array(dense).asformat(form)
    result = checks.csr("T", matrix)
    assert type(result) is scipy.sparse.csr_array
    np.testing.assert_array_equal(result.toarray(), dense)
    # Again by hand: SciPy remembers what it once found.
    assert all(np.all(np.diff(result.indices[a:b]) > 0) for a, b in itertools.pairwise(result.indptr))


def test_disorder_is_seen_even_where_scipy_remembers_order():
    matrix = scipy.sparse.csr_array(np.array([[1, 2, 3]], np.float32))
    assert matrix.has_canonical_format
    matrix.indices[:] = [2, 1, 0]  # as a program that fills the arrays of a matrix in place
    result = checks.csr("T", matrix)
    assert result.indices.tolist() == [0, 1, 2]
    assert result.toarray().tolist() == [[3, 2, 1]]


def test_memory_of_the_host_is_asked_first(monkeypatch):
    assert checks.host_memory() > 1 << 20
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 20)
    checks.fits_host("a matrix", 1 << 20)
    with pytest.raises(MemoryLimitError, match=r"^a matrix needs 1 GiB, but the host has 1 MiB free$"):
        checks.fits_host("a matrix", 1 << 30)


def test_memory_is_known_without_proc(monkeypatch):
    def missing(*_, **__):
        raise FileNotFoundError

    monkeypatch.setattr("builtins.open", missing)
    assert checks.host_memory() > 1 << 20


@pytest.mark.parametrize(
    ("nbytes", "text"),
    [
        (0, "0 B"),
        (1023, "1023 B"),
        (1536, "1.5 KiB"),
        (1 << 20, "1 MiB"),
        (3 << 30, "3 GiB"),
        (1 << 50, "1024 TiB"),
    ],
)
def test_sizes_as_people_read_them(nbytes, text):
    assert checks.size(nbytes) == text


@pytest.mark.parametrize("form", ["csr", "csc", "coo", "bsr", "dia"])
def test_half_precision_is_converted(form):
    matrix = gallery.sparse(5, 7).asformat(form)
    wanted = matrix.toarray().astype(np.float16)
    matrix.data = matrix.data.astype(np.float16)
    np.testing.assert_array_equal(checks.csr("T", matrix).toarray(), wanted)
