# SPDX-License-Identifier: BSD-3-Clause
"""Refusals name the argument and its value in one line; what is good passes unchanged."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Dense
from tests import gallery


def csr(indptr, indices, data, shape=(2, 3)):
    """A csr_array as it stands, with nothing checked: as read from a spoilt file."""
    matrix = scipy.sparse.csr_array(shape)
    matrix.indptr = np.asarray(indptr)
    matrix.indices = np.asarray(indices)
    matrix.data = np.asarray(data)
    return matrix


def of(check: Callable[..., object], *values: object) -> list[tuple[Callable[[str], object], str]]:
    """Each of these values is refused, and named."""
    return [(lambda name, v=v: check(name, v), re.escape(repr(v))) for v in values]


P = [0, 1, 3]
I = [0, 0, 2]
X = [1.0, 2.0, 3.0]
# The argument and the value that each refusal names.
REFUSED: list[tuple[Callable[[str], object], str]] = [
    (lambda name: checks.finite(name, np.array([0, np.nan])), "1 NaN .* at 1;"),
    (
        lambda name: checks.finite(name, np.array([[0, np.inf], [-np.inf, 0]])),
        r"2 NaN .* at \(0, 1\)",
    ),
    (lambda name: checks.shape(name, np.zeros(3), (4,), (4, 2)), r"\(3,\).*\(4,\) or \(4, 2\)"),
    *of(checks.grid, (1, 2, 3), 7, (2.5, 2), "44", (0, 4)),
    *of(checks.number, None, "1", True, np.nan),
    *of(checks.interval, (1, 1)),
    *of(checks.count, 0, 2.0, True),
    (lambda name: checks.grid(name, (np.inf, 1)), "inf"),
    (lambda name: checks.grid(name, (2, 3), 5), "6.* 5"),
    (lambda name: checks.number(name, 0.0, above=0), "0.0; .* above 0"),
    (lambda name: checks.number(name, 1.5, least=0, most=1), "1.5; .* at least 0 and at most 1"),
    (lambda name: checks.number(name, 1, below=1), "1; .* below 1"),
    (lambda name: checks.interval(name, (0, np.inf)), "inf"),
    (lambda name: checks.count(name, 4, most=3), "4.* 3"),
    (lambda name: checks.one_of(name, "magic", ["jacobi", "cg"]), "'magic'.*jacobi, cg"),
    (lambda name: checks.csr(name, scipy.sparse.coo_array([1.0, 2.0])), r"\(2,\)"),
    (lambda name: checks.csr(name, csr(P, I, [1, np.nan, 3])), "data .*1 NaN"),
    (lambda name: checks.csr(name, scipy.sparse.coo_array([[np.nan]])), "data .*1 NaN"),
    (lambda name: checks.csr(name, csr(P, [0, 0, 3], X)), r"indices .*3; .*0\.\.2"),
    (lambda name: checks.csr(name, csr(P, [0, -1, 2], X)), "indices .*-1"),
    (lambda name: checks.csr(name, csr(P, [0, 0, 3], X).T), r"indices .*3; .*0\.\.2"),
    (lambda name: checks.csr(name, csr([0, 3, 2], I, X)), "indptr .*never fall"),
    (lambda name: checks.csr(name, csr([0, 5, 0], np.zeros(0, int), [])), "indptr .*never fall"),
    (lambda name: checks.csr(name, csr([0, 3], I, X)), "indptr .*2 entries.* 3"),
    (lambda name: checks.csr(name, csr([1, 2, 3], I, X)), "indptr .*from 1"),
    (lambda name: checks.csr(name, csr(np.zeros(0, int), I, X)), "indptr .*0 entries"),
    (lambda name: checks.csr(name, csr([0, 1, 2], I, X)), "ends at 2 with 3 indices and 3"),
    (lambda name: checks.csr(name, csr(P, [0, 1], X)), "ends at 3 with 2 indices and 3"),
    (lambda name: checks.csr(name, csr(P, I, [1.0])), "ends at 3 with 3 indices and 1"),
    (lambda name: checks.csr(name, csr([0.0, 1, 3], I, X)), "indptr .*float64"),
    (lambda name: checks.csr(name, csr(P, I, [[1.0], [2], [3]])), r"data .*\(3, 1\)"),
]
WRONG_TYPES: list[tuple[Callable[[str], object], str]] = [
    (lambda name: checks.real(name, np.ma.masked_greater(np.arange(4.0), 2)), "1 masked"),
    (
        lambda name: checks.real(name, [np.ma.masked_greater(np.arange(4.0), 2), np.ones(4)]),
        "1 masked",
    ),
    *of(checks.real, "wall.png", None),
    (lambda name: checks.real(name, Path("wall.png")), "'wall.png'"),
    (lambda name: checks.real(name, ["a"]), "<U1"),
    (lambda name: checks.real(name, [1j]), "complex"),
    (lambda name: checks.real(name, [None]), "object"),
    (lambda name: checks.flag(name, 1), "1"),
    (lambda name: checks.csr(name, scipy.sparse.coo_array([[1j]])), "complex"),
    (lambda name: checks.csr(name, np.eye(2)), "ndarray"),
]


@pytest.mark.parametrize(
    ("kind", "check", "value"),
    [(InputError, *case) for case in REFUSED] + [(InputTypeError, *case) for case in WRONG_TYPES],
)
def test_bad_values_are_refused_by_name(kind, check, value):
    with pytest.raises(kind, match=rf"\Aargument.*{value}") as error:
        check("argument")
    assert "\n" not in str(error.value)


def test_good_values_are_handed_on():
    array = np.array([1.0, -2.0])
    assert checks.real("b", array) is array
    assert checks.shape("b", array, (3,), (2,)) is array
    assert checks.grid("grid", np.array([2, 3]), 6) == checks.grid("grid", [2.0, 3.0]) == (2, 3)
    assert checks.number("m", np.float32(0.5), above=0, below=1) == 0.5
    assert checks.number("m", 1, least=1, most=1) == 1.0
    assert checks.count("k", np.int64(3)) == 3
    np.testing.assert_array_equal(checks.real("b", np.ma.masked_array(array, False)), array)


@pytest.mark.parametrize("times", ["product", "transposed", "upload"])
def test_no_product_drops_a_mask(device, times):
    A = Dense(device, np.eye(2))
    x = np.ma.masked_array([1.0, 2.0], [False, True])
    with pytest.raises(InputTypeError, match="1 masked"):
        {"product": A.dot, "transposed": A.T.dot, "upload": device.upload}[times](x)


@pytest.mark.parametrize(
    "array",
    [
        np.full(4, 1e308),
        np.array([3e38, 3e38], np.float32),
        np.zeros(0),
        np.arange(3),
        np.ones(2, bool),
    ],
)
def test_finite_numbers_pass_even_where_their_sum_does_not(array):
    assert checks.finite("b", array) is array


@pytest.mark.parametrize("form", ["csr", "csc", "coo", "lil", "dok", "bsr", "dia"])
@pytest.mark.parametrize("dtype", ["float16", "float32", "float64", "int8", "bool"])
def test_every_sparse_format_becomes_a_canonical_csr_array(form, dtype):
    half = dtype == "float16"
    dense = (gallery.sparse(5, 7).toarray() * 100).astype(dtype)
    matrix = scipy.sparse.coo_array(dense.astype("float32" if half else dtype)).asformat(form)
    if half and form in (
        "csr",
        "csc",
        "coo",
        "bsr",
        "dia",
    ):  # the others compute with it themselves
        matrix.data = matrix.data.astype(dtype)
    result = checks.csr("T", matrix)
    assert type(result) is scipy.sparse.csr_array
    np.testing.assert_array_equal(result.toarray(), dense)
    row = np.repeat(np.arange(5), np.diff(result.indptr))
    # By hand: SciPy remembers what it once saw.
    assert np.all(np.diff(row * 7 + result.indices) > 0)


def test_disorder_is_seen_even_where_scipy_remembers_order():
    matrix = scipy.sparse.csr_array(np.array([[1, 2, 3]], np.float32))
    assert matrix.has_canonical_format
    matrix.indices[:] = [2, 1, 0]  # as a program that fills the arrays of a matrix in place
    assert checks.csr("T", matrix).toarray().tolist() == [[3, 2, 1]]


def test_memory_of_the_host_is_asked_first(monkeypatch):
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 20)
    checks.fits_host("a matrix", 1 << 20)
    with pytest.raises(MemoryLimitError, match=r"a matrix .*1 GiB.*1 MiB"):
        checks.fits_host("a matrix", 1 << 30)


@pytest.mark.skipif(sys.platform != "linux", reason="a limit of addresses is Linux's")
def test_memory_is_what_a_limit_of_the_process_leaves():
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    used = (
        int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        * resource.getpagesize()
    )
    resource.setrlimit(resource.RLIMIT_AS, (used + (64 << 20), before[1]))
    try:
        assert checks.host_memory() <= 64 << 20
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
