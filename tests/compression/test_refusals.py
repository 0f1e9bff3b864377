# SPDX-License-Identifier: BSD-3-Clause
"""What `compress` refuses says which argument it was, what it was, and what it must be."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import InputError, InputTypeError, MemoryLimitError


def corner(n: int = 4) -> ltcl.Transport:
    return ltcl.scenes.dihedral(n, albedo=0.6).transport()


class Rows:
    """Rows of a transport, cut to so many columns, or of another type."""

    shape: Any = (128, 128)

    def __init__(self, columns: int = 128, dtype: Any = float) -> None:
        self.columns, self.dtype = columns, dtype

    def rows(self, start: int, stop: int) -> np.ndarray:
        return np.eye(128)[start:stop, : self.columns].astype(self.dtype)


@pytest.mark.parametrize("memory", ["1GB", -1, 0, 2.5, True])
def test_memory_is_whole_bytes(memory):
    text = re.escape(f"memory is {memory!r}; it must be a whole number of at least 1")
    with pytest.raises(InputError, match=text):
        ltcl.compress(np.eye(6), grid=(2, 3), memory=memory)
    with pytest.raises(InputError, match=text):
        ltcl.compress(corner(), memory=memory)


def test_memory_for_no_block_is_refused():
    with pytest.raises(MemoryLimitError, match="memory is 100 B; blocks of 16 rows of 6 values need"):
        ltcl.compress(np.eye(6), grid=(2, 3), memory=100)


@pytest.mark.parametrize("basis", [3, 0.5, True])
@pytest.mark.parametrize("task", [ltcl.compress, ltcl.invert])
def test_a_basis_is_a_name_or_several(task, basis):
    with pytest.raises(InputTypeError, match=f"basis is {basis!r}; it must be a name, .*or a list of names$"):
        task(corner(), basis=basis)
    with pytest.raises(InputTypeError, match=f"basis is {basis!r}; it must be a name"):
        task(corner(), basis=["db2", basis])
    with pytest.raises(InputError, match="basis is empty; it must name at least one"):
        task(corner(), basis=[])


@pytest.mark.parametrize("first_bounce", [None, np.ones(128)])
def test_rows_must_be_what_the_shape_says(first_bounce):
    given = {"grid": (8, 16), "first_bounce": first_bounce, "memory": 32 * 128 * 64}
    with pytest.raises(InputError, match=r"^T\.rows\(0, 1\) gave shape \(1, 3\); it must be \(1, 128\)$"):
        ltcl.compress(Rows(3), **given)
    with pytest.raises(InputTypeError, match=r"^T\.rows\(0, 1\) holds complex128; it must hold real"):
        ltcl.compress(Rows(dtype=complex), **given)
    wrong = Rows()
    wrong.shape = 128
    with pytest.raises(InputError, match=r"^T has shape 128; it must be \(M, N\)$"):
        ltcl.compress(wrong, **given)


@pytest.mark.parametrize("more", [1, 100])
@pytest.mark.parametrize("first_bounce", [None, np.ones(128)])
@pytest.mark.parametrize("basis", [None, "db2"])
def test_rows_are_no_more_than_were_asked_for(more, first_bounce, basis):
    """Also where all are asked for at once, of which a slice has no more than there are."""

    class Generous(Rows):
        def rows(self, start: int, stop: int) -> np.ndarray:
            return np.eye(128)[start : stop + more]

    class Sliced:
        shape, dtype = (128, 128), np.dtype(float)

        def __getitem__(self, key: slice) -> np.ndarray:
            return np.eye(128)[key.start : key.stop + more]

    for T, call in ((Generous(), r"T\.rows\(0, 1\)"), (Sliced(), r"T\[0:1\]")):
        text = rf"^{call} gave shape \({1 + more}, 128\); it must be \(1, 128\)$"
        with pytest.raises(InputError, match=text):
            ltcl.compress(T, grid=(8, 16), first_bounce=first_bounce, basis=basis)


@pytest.mark.parametrize("make", [corner, lambda: ltcl.scenes.box(4, sides=3, albedo=0.7).transport()])
@pytest.mark.parametrize("basis", ["db2", "pixels", ["haar", "db2 + pixels"]])
def test_what_float32_does_not_keep_is_refused_with_what_it_does(make, basis):
    T = make()
    with pytest.raises(InputError, match=r"rtol is 1e-12, which float32 does not keep for this T") as refused:
        ltcl.compress(T, 1e-12, basis=basis)
    found = re.search(r"; the least that it does is ([\d.e-]+)$", str(refused.value))
    assert found is not None
    least = float(found[1])
    assert 1e-12 < least < 1e-3
    assert ltcl.compress(T, least, basis=basis).error <= least
    with pytest.raises(InputError, match="which float32 does not keep"):
        ltcl.compress(T, least / 10, basis=basis)


def test_a_report_tells_where_nothing_was_gained():
    T = corner()
    C = ltcl.compress(T, 1e-5, basis="db2")
    assert C.compression.uncompressed == 4 * T.shape[0] ** 2 <= C.compression.nbytes
    assert "KiB, more than T's 4 KiB, in db2, solutions within" in str(C.compression)
    small = ltcl.compress(corner(12), 0.1, basis="db2").compression
    assert f" of {ltcl.checks.size(4 * 288**2)}, in db2, solutions within 0.0" in str(small)


def test_other_refusals():
    T, rows = corner(), np.eye(6)
    with pytest.raises(InputError, match="grid is 2 x 4"):
        ltcl.compress(rows, grid=(2, 4))
    with pytest.raises(InputError, match="grid is None, but T is no Transport"):
        ltcl.compress(rows)
    with pytest.raises(InputError, match=r"T has shape \(6, 5\); it must be square"):
        ltcl.compress(rows[:, :5], grid=(1, 6))
    with pytest.raises(InputError, match="T has 2 channels"):
        ltcl.compress([rows, rows], grid=(2, 3))
    with pytest.raises(InputError, match="only relight"):
        ltcl.compress(ltcl.Transport(np.ones((6, 4)), (2, 2), camera_grid=(2, 3)))
    with pytest.raises(InputError, match="first_bounce is zero or negative at 1 of 6 pixels, the first 2"):
        ltcl.compress(rows * (np.arange(6) != 2), grid=(2, 3))
    with pytest.raises(InputError, match="grid is given, but T is a Transport"):
        ltcl.compress(T, grid=(1, 1))
    with pytest.raises(InputError, match="budget is 0"):
        ltcl.compress(T, budget=0)
    with pytest.raises(InputTypeError, match="T is a str"):
        ltcl.compress("T.npz", grid=(2, 3))
    with pytest.raises(InputError, match="compressed already"):
        ltcl.compress(ltcl.compress(T))
