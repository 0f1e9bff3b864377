# SPDX-License-Identifier: BSD-3-Clause
"""Tables of walks: to the bit those of the twin, and their probabilities those of the rows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import SAMPLERS, Tables, tables, tables_of_columns
from tests import gallery, reference

TINY = float(np.finfo(np.float32).tiny)
# Rows that are hard to scale: of one value, of zeros, huge, denormal, spread over all of float32.
HARD = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, -3e38, 0.0, 0.0, 0.0],
        [1e-45, 3e-45, 0.0, -1e-44, 0.0],
        [TINY, -TINY, TINY, TINY, 1e-45],
        [1.0, 1e-30, -1e-38, 1e30, 1.0],
        [8.5e37, -8.5e37, 8.5e37, 8.5e37, 0.0],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        [1.0, 1.0, 1.0, 1.0, np.nextafter(np.float32(1), np.float32(2))],
    ],
    np.float32,
)
DENSE = gallery.DENSE | {"hard": HARD}
SPARSE = gallery.SPARSE | {"hard": scipy.sparse.csr_array(HARD)}


Row = tuple[np.ndarray, np.ndarray]  # columns, values


def matches(made: Tables, rows: list[Row], twin: Callable[..., tuple]) -> None:
    """Assert that the table of every row is that of its twin."""
    records, entries = made.records.get(), made.entries.get()
    starts = records[:, 0].astype(np.uint64) | records[:, 1].astype(np.uint64) << np.uint64(32)
    for i, (columns, values) in enumerate(rows):
        count, total, table = twin(columns, values)
        assert (made.counts()[i], made.sums()[i]) == (count, total)
        if table:
            start = int(starts[i])
            assert entries[start : start + len(values)].tolist() == table


def rows_of(A: scipy.sparse.csr_array) -> list[Row]:
    parts = zip(A.indptr[:-1], A.indptr[1:], strict=True)
    return [(A.indices[a:b], A.data[a:b]) for a, b in parts]


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("name", SPARSE)
def test_sparse_tables_are_those_of_the_twin(device, name, sampler):
    made = tables(CSR(device, SPARSE[name]), sampler)
    matches(made, rows_of(SPARSE[name]), lambda *row: reference.alias_csr(row[0], row[1], sampler))


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("name", DENSE)
def test_dense_tables_are_those_of_the_twin(device, name, sampler):
    made = tables(Dense(device, DENSE[name]), sampler)
    rows = [(np.arange(len(row)), row) for row in DENSE[name]]
    matches(made, rows, lambda _, values: reference.alias_dense(values, sampler))


def test_slabs_give_the_same_tables(device, small_device):
    A = gallery.sparse(53, 53, 0.3)
    small_device.max_allocation = 3000
    sparse, dense = CSR(small_device, A), Dense(small_device, A.toarray())
    small_device.max_allocation = 1 << 16
    for cut, whole in ((sparse, CSR(device, A)), (dense, Dense(device, A.toarray()))):
        assert len(cut.slabs) > 1
        assert tables(cut).entries.get().tolist() == tables(whole).entries.get().tolist()
        assert tables(cut).records.get().tolist() == tables(whole).records.get().tolist()


def probabilities(made: Tables, row: int, columns: int) -> np.ndarray:
    """What an alias table draws: (2, columns), positive and negative."""
    found = np.zeros(2 * columns)
    start, _, count, _ = made.records.get()[row].tolist()
    for entry in made.entries.get()[start : start + count].tolist():
        threshold = (entry >> 46) / 2**18
        found[entry >> 23 & 0x7FFFFF] += threshold / count
        found[entry & 0x7FFFFF] += (1 - threshold) / count
    return found.reshape(columns, 2).T


@pytest.mark.parametrize("name", [name for name in DENSE if name != "zeros"])
def test_bins_sum_to_the_probabilities_of_the_row(device, name):
    """In total variation within 2^-18, and signs in their place."""
    A = DENSE[name].astype(np.float64)
    made = tables(Dense(device, DENSE[name]))
    for row, values in enumerate(A):
        found = probabilities(made, row, A.shape[1])
        total = np.abs(values).sum()
        assert made.counts()[row] == (A.shape[1] if total >= TINY else 0)
        if total >= TINY:
            wanted = np.stack([np.maximum(values, 0), np.maximum(-values, 0)]) / total
            assert np.abs(found - wanted).sum() / 2 <= 2.0**-18
            assert made.sums()[row] == pytest.approx(total, rel=2.0**-23)


def test_columns_are_the_rows_of_the_transpose(device):
    A = gallery.sparse(37, 37, 0.4)
    for M in (CSR(device, A), Dense(device, A.toarray())):
        made, wanted = (
            tables_of_columns(M),
            tables(type(M)(device, A.T if M.file == "csr" else A.toarray().T)),
        )
        assert made.records.get()[:37].tolist() == wanted.records.get().tolist()
        assert made.entries.get()[:-37].tolist() == wanted.entries.get().tolist()
        b = gallery.vectors(37, None, 5)
        made.append(device.upload(b))
        count, total, table = reference.alias_dense(b, "alias")
        assert (made.counts()[37], made.sums()[37]) == (count, total)
        assert made.entries.get()[-37:].tolist() == table


def test_they_are_made_once_and_live_with_their_matrix(device):
    M = Dense(device, gallery.signed(9, 9))
    assert tables(M) is tables(M)
    assert tables(M, "cdf") is not tables(M)
    assert tables_of_columns(M) is tables_of_columns(M)
    assert tables(M).nbytes == 9 * 9 * 8 + 9 * 16


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_a_row_whose_sum_overflows_is_refused(device, sampler):
    with pytest.raises(
        InputError, match=r"1 row\(s\) of R, first of row 1, sum to more than float32"
    ) as caught:
        tables(Dense(device, [[1.0, 1.0], [3e38, -3e38]]), sampler)
    assert "\n" not in str(caught.value)


def test_what_no_entry_can_hold_is_refused(device):
    wide = scipy.sparse.csr_array((np.ones(1), ([0], [1 << 22])), shape=(1, (1 << 22) + 1))
    with pytest.raises(InputError, match="R has 4194305 columns; walks take at most 4194304"):
        tables(CSR(device, wide))
    with pytest.raises(InputError, match="sampler is 'walker'; it must be one of alias, cdf, uniform"):
        tables(Dense(device, np.eye(2)), "walker")


def test_tables_beyond_the_largest_buffer_are_refused(small_device):
    M = Dense(small_device, gallery.signed(40, 40))
    with pytest.raises(MemoryLimitError, match=r"tables of the 1600 entries of R need 12.5 KiB .* 3.984 KiB"):
        tables(M)
