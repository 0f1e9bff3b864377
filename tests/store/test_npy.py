# SPDX-License-Identifier: BSD-3-Clause
"""Dense .npy files: good ones come back exactly, others are refused by their header."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from ltcl.errors import FileError, MemoryLimitError
from ltcl.store import formats
from ltcl.store.record import Record
from tests.store.helpers import dense, record_in, refusal, same, sparse


def header(descr: str, shape: str, fortran: str = "False", body: bytes = b"") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + body


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(("channels", "M"), [(1, 12), (1, 5), (3, 12), (3, 20)])
def test_matrices_come_back(tmp_path, channels, M, dtype):
    record = Record(tuple(dense(M, 12, dtype, seed) for seed in range(channels)))
    formats.write(tmp_path / "T.npy", record)
    same(record_in(tmp_path / "T.npy"), record)
    assert np.load(tmp_path / "T.npy").shape == ((M, 12) if channels == 1 else (3, M, 12))  # NumPy agrees


@pytest.mark.parametrize(
    ("stored", "read"),
    [
        (">f4", "f4"),
        (">f8", "f8"),
        ("f2", "f4"),
        ("u1", "f4"),
        (">u2", "f4"),
        ("i4", "f8"),
        ("u8", "f8"),
        ("?", "f4"),
    ],
)
@pytest.mark.parametrize("order", ["C", "F"])
def test_foreign_byte_orders_and_types_become_native_floats(tmp_path, stored, read, order):
    T = np.asarray(dense(4, 6).astype(stored), order=order)
    np.save(tmp_path / "T.npy", T)
    (result,) = record_in(tmp_path / "T.npy").matrices
    assert result.dtype == np.dtype(read)
    assert result.dtype.isnative
    np.testing.assert_array_equal(result, T.astype(read))


def test_large_matrices_are_written_in_blocks(tmp_path):
    T = np.asfortranarray(np.arange(2100 * 2500, dtype=np.float32).reshape(2100, 2500))
    formats.write(tmp_path / "T.npy", Record((T,)))
    np.testing.assert_array_equal(np.load(tmp_path / "T.npy"), T)


def test_a_single_channel_in_front_is_dropped(tmp_path):
    np.save(tmp_path / "T.npy", dense()[None])
    same(record_in(tmp_path / "T.npy"), Record((dense(),)))


def test_sparse_matrices_are_refused(tmp_path):
    with pytest.raises(FileError, match=r"T\.npy: T is sparse.*\.npz"):
        formats.write(tmp_path / "T.npy", Record((sparse(),)))
    assert list(tmp_path.iterdir()) == []


def test_a_lost_first_bounce_is_said(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        formats.write(tmp_path / "T.npy", Record((dense(),), first_bounce=dense().diagonal()))
        assert not caplog.messages
        formats.write(tmp_path / "T.npy", Record((dense(),), first_bounce=np.ones(12)))
    assert "does not keep the first bounce" in caplog.messages[0]


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"PK\x03\x04 an archive under another name", "begins with b'PK"),
        (b"\x93NUMP", "begins with"),
        (b"\x93NUMPY\x09\0\x76\0\0\0", "version 9"),
        (b"\x93NUMPY\x02\0\xff\xff\xff\xff", "4294967295 bytes"),
        (b"\x93NUMPY\x01\0\x76\0{'descr'", "truncated inside its header"),
        (header("'<f4'", "(4, 4)", body=bytes(60)), "declares float32 (4, 4), 64 bytes, but 60 follow"),
        (header("'<f4'", "(4, 4)", body=bytes(68)), "64 bytes, but 68 follow"),
        (header("'<f4'", "(4000000, 4000000)"), "declares float32 (4000000, 4000000)"),
        (header("'<f4'", f"({2**62}, {2**62})"), "truncated, or its header lies"),
        (header("'<f4'", f"({2**70}, 1)"), "impossible header"),
        (header("'<f4'", "(-4, -4)", body=bytes(64)), "impossible header"),
        (header("'<f4'", "(True, 4)", body=bytes(16)), "impossible header"),
        (header("'<f4'", "4", body=bytes(16)), "unreadable header"),
        (header("'<f4'", "(4, 4)", "0", body=bytes(64)), "impossible header"),
        (header("'<f4'", "(" * 3000), "unreadable header"),
        (header("__import__('os')", "(4, 4)"), "unreadable header"),
        (header("'|O'", "(4, 4)", body=bytes(128)), "pickled Python objects, which are never loaded"),
        (header("'<c8'", "(4, 4)", body=bytes(128)), "it must hold real numbers"),
        (header("'<U1'", "(4, 4)", body=bytes(64)), "it must hold real numbers"),
        (header("'<M8[s]'", "(4, 4)", body=bytes(128)), "it must hold real numbers"),
        (header("[('x', '<f4')]", "(4, 4)", body=bytes(64)), "it must hold real numbers"),
        (header("'<f1'", "(4, 4)", body=bytes(16)), "it must hold real numbers"),
        (header("'<f4'", "(16,)", body=bytes(64)), "shape (16,); T must be (M, N) or (3, M, N)"),
        (header("'<f4'", "(2, 2, 4)", body=bytes(64)), "shape (2, 2, 4)"),
        (header("'<f4'", "(0, 4)"), "not empty"),
        (header("'<f4'", "()", body=bytes(4)), "shape ()"),
    ],
)
def test_headers_that_lie_or_ask_for_the_wrong_thing(tmp_path, data, text):
    (tmp_path / "T.npy").write_bytes(data)
    assert text in refusal(tmp_path / "T.npy", FileError)


def test_an_honest_giant_is_a_matter_of_memory(tmp_path, monkeypatch):
    np.save(tmp_path / "T.npy", np.asfortranarray(dense(100, 100)))  # turned to C order: held twice
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 79_999)
    assert "float32 (100, 100), needs 78.12 KiB" in refusal(tmp_path / "T.npy", MemoryLimitError)
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 80_000)
    assert record_in(tmp_path / "T.npy").shape == (100, 100)
