# SPDX-License-Identifier: BSD-3-Clause
"""Matrix Market files: values and grids come back, lines of sizes that lie are refused."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.io
import scipy.sparse

from ltcl.errors import FileError, MemoryLimitError
from ltcl.store import formats
from ltcl.store.record import Record
from tests.store.helpers import as_dense, dense, record_in, refusal, same, sparse

COORDINATE = b"%%MatrixMarket matrix coordinate real general\n"
ARRAY = b"%%MatrixMarket matrix array real general\n"


@pytest.mark.parametrize(
    "matrix", [sparse(dtype="float64"), dense(dtype="float64"), dense(20, 12, "float64")]
)
@pytest.mark.parametrize("grids", [(None, None), ((3, 4), None), ((3, 4), (1, 12))])
@pytest.mark.parametrize("name", ["T.mtx", "T.MTX"])
def test_records_come_back(tmp_path, matrix, grids, name):
    record = Record((matrix,), *grids)
    formats.write(tmp_path / name, record)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    same(record_in(tmp_path / name), record)


def test_float32_comes_back_exactly_as_float64_would_round_to_it(tmp_path):
    formats.write(tmp_path / "T.mtx", Record((sparse(),)))
    (result,) = record_in(tmp_path / "T.mtx").matrices
    assert result.dtype == np.float64
    np.testing.assert_array_equal(as_dense(result).astype(np.float32), sparse().toarray())


@pytest.mark.parametrize("symmetry", ["general", "symmetric", "skew-symmetric"])
@pytest.mark.parametrize("make", [np.asarray, scipy.sparse.coo_array])
@pytest.mark.parametrize("field", ["real", "integer"])
def test_files_of_others_are_read(tmp_path, make, symmetry, field):
    T = np.arange(16.0).reshape(4, 4)
    T = {"general": T, "symmetric": T + T.T, "skew-symmetric": T - T.T}[symmetry]
    scipy.io.mmwrite(
        tmp_path / "T.mtx", make(T), symmetry=symmetry, field=field, comment="ltcl knows nothing of me"
    )
    (result,) = record_in(tmp_path / "T.mtx").matrices
    np.testing.assert_array_equal(as_dense(result), T)


COLOURS = ["T_r.mtx", "T_g.mtx", "T_b.mtx"]


@pytest.mark.parametrize("make", [sparse, dense])
@pytest.mark.parametrize("grids", [(None, None), ((3, 4), (2, 6))])
def test_colour_is_three_files(tmp_path, make, grids):
    T = tuple(
        make(12, dtype="float64", seed=k) if make is sparse else make(12, 12, "float64", k) for k in (1, 2, 3)
    )
    formats.write(tmp_path / "T.mtx", Record(T, *grids))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(COLOURS)
    same(record_in(tmp_path / "T.mtx"), Record(T, *grids))
    for name, one in zip(COLOURS, T, strict=True):  # each is a file that anybody reads
        found = scipy.io.mmread(tmp_path / name)
        np.testing.assert_array_equal(scipy.sparse.csr_array(found).toarray(), as_dense(one))
        same(record_in(tmp_path / name), Record((one,), *grids))


def test_channels_that_do_not_fit_are_refused(tmp_path):
    formats.write(tmp_path / "T.mtx", Record((sparse(), sparse(), sparse()), (3, 4)))
    for other, text in (
        (Record((sparse(6),)), r"channels of the shapes \(12, 12\), \(6, 6\), \(12, 12\)"),
        (Record((sparse(),), (2, 6)), r"channels of the grids \(3, 4\), \(2, 6\), \(3, 4\)"),
        (Record((dense(),), (3, 4)), "dense and sparse channels"),
    ):
        formats.write(tmp_path / "T_g.mtx", other)
        assert re.search(text, refusal(tmp_path / "T.mtx", FileError))
    (tmp_path / "T_g.mtx").unlink()
    with pytest.raises(FileError, match=r"T_g\.mtx: "):
        formats.read(tmp_path / "T.mtx")


def test_a_grey_file_is_not_hidden_behind_colour(tmp_path):
    formats.write(tmp_path / "T.mtx", Record((sparse(),)))
    with pytest.raises(FileError, match=r"T\.mtx: is there, and would be read in place of .* T_r\.mtx"):
        formats.write(tmp_path / "T.mtx", Record((sparse(), sparse(), sparse())))
    assert [path.name for path in tmp_path.iterdir()] == ["T.mtx"]


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"\x93NUMPY\x01\0", "is no Matrix Market file"),
        (b"%%MatrixMarket vector coordinate real general\n3 1\n1 1\n", "is no Matrix Market file"),
        (
            COORDINATE.replace(b"real", b"complex") + b"2 2 1\n1 1 1 1\n",
            "field b'complex'; it must be real or",
        ),
        (COORDINATE.replace(b"real", b"pattern") + b"2 2 1\n1 1\n", "field b'pattern'"),
        (COORDINATE.replace(b"general", b"hermitian") + b"2 2 1\n1 1 1\n", "symmetry b'hermitian'"),
        (COORDINATE, "no line of sizes"),
        (COORDINATE + b"% words\n" * 10, "no line of sizes"),
        (COORDINATE + b"2 2\n", "it must be 'rows columns entries'"),
        (COORDINATE + b"-2 2 1\n1 1 1\n", "it must be 'rows columns entries'"),
        (COORDINATE + b"2 2 99999999999999999999\n", "it must be 'rows columns entries'"),
        (ARRAY + b"2 2 4\n1\n1\n1\n1\n", "it must be 'rows columns'"),
        (COORDINATE + b"9 9 1000000000000\n1 1 1\n", "declares 3000000000000 numbers"),
        (COORDINATE + b"9 9 3\n1 1 1\n", "declares 9 numbers, at least 18 bytes, but 6 bytes follow"),
        (
            COORDINATE + b"9 9 2\n1 1 1.00\n2 2 1.00\n3 3 1.00\n",
            "goes on with b'3 3 1.00' after the 6 numbers",
        ),
        (COORDINATE + b"9 9 2\n1 1 1.00000000000\n", "3 of 6 numbers"),
        (COORDINATE + b"9 9 1\n1 1 1.5", "ends inside its last line"),
        (COORDINATE + b"9 9 1\n1 1 1.5E", "ends inside its last line"),
        (COORDINATE + b"900000000000 9 1\n1 1 1\n", "declared as (900000000000, 9) with 1 entries"),
        (COORDINATE + b"0 9 0\n", "declared as (0, 9)"),
        (COORDINATE.replace(b"general", b"symmetric") + b"2 3 1\n1 1 1\n", "must be square"),
        (ARRAY + b"2000000 2000000\n1\n", "declares 4000000000000 numbers"),
        (ARRAY.replace(b"general", b"symmetric") + b"2000000 2000000\n1\n", "declares 2000001000000 numbers"),
        (ARRAY + b"2 2\n1\n1\n1\nx\n", "no number among its values"),
        (COORDINATE + b"2 2 1\n3 1 1\n", "has the row 3 in entry 1; it must be in 1..2"),
        (COORDINATE + b"2 2 2\n1 1 1\n1 0 1\n", "has the column 0 in entry 2"),
        (COORDINATE + b"2 2 1\n1.5 1 1\n", "has the row 1.5"),
        (COORDINATE + b"2 2 1\nnan 1 1\n", "has the row nan"),
        (COORDINATE + b"2 2 1\n1 inf 1\n", "has the column inf"),
        (COORDINATE + b"2 2 1\n1 99999999999999999999 1\n", "has the column 1e+20"),
        (COORDINATE + b"2 2 1\n1 1 one\n", "no number among its values"),
    ],
)
def test_headers_and_bodies_that_lie(tmp_path, data, text):
    (tmp_path / "T.mtx").write_bytes(data)
    assert text in refusal(tmp_path / "T.mtx", FileError)


def test_an_honest_giant_is_a_matter_of_memory(tmp_path, monkeypatch):
    (tmp_path / "T.mtx").write_bytes(COORDINATE + b"900 900 900\n" + b"1 1 1\n" * 900)
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 60_000)
    assert "host has" in refusal(tmp_path / "T.mtx", MemoryLimitError)
