# SPDX-License-Identifier: BSD-3-Clause
"""Blocks of columns of T into blocks of rows, with bounded memory.

One pass counts the entries of every row. Then as many blocks of rows at a time as fit are gathered from all
columns, in one pass each: columns ascend, so a stable sort by row leaves every row in order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks

if TYPE_CHECKING:
    from ltcl.store.blocks.block_store import BlockStore

Change = Callable[[int, int, Any, Any], tuple[Any, Any]]
"""Of channel, first row, rows and the variance of their entries: what is committed of these."""
_PER_ENTRY = 64  # bytes: places, values and variance, as gathered, joined and sorted


class _Entries(NamedTuple):
    row: np.ndarray
    column: np.ndarray
    value: np.ndarray
    variance: np.ndarray | None


def turn(store: BlockStore, memory: int, change: Change | None = None) -> None:
    """Commit every block of rows that is not there yet, changed where that is asked for."""
    checks.count("memory", memory, least=_PER_ENTRY)
    for channel in range(store.layout.channels):
        missing = [block for c, block in store.missing("rows") if c == channel]
        if missing:
            counts = _entries_of_rows(store, channel)
            for first, last in _batches(store, missing, counts, memory // _PER_ENTRY):
                _turn(store, channel, first, last, change)


def _entries_of_rows(store: BlockStore, channel: int) -> np.ndarray:
    rows = store.layout.shape[0]
    counts = np.zeros(rows, np.int64)
    for block in range(store.layout.blocks("columns")):
        counts += np.bincount(store.block(channel, block, "columns").matrix.indices, minlength=rows)
    return counts


def _batches(
    store: BlockStore, missing: list[int], counts: np.ndarray, most: int
) -> Iterator[tuple[int, int]]:
    """Runs (first, last) of neighbouring blocks of rows that together have at most `most` entries, or one."""
    sizes = [int(counts[slice(*store.layout.span(block))].sum()) for block in missing]
    first, held = 0, 0
    for place, size in enumerate(sizes):
        ends = place > first and (held + size > most or missing[place] != missing[place - 1] + 1)
        if ends:
            yield missing[first], missing[place - 1]
            first, held = place, 0
        held += size
    yield missing[first], missing[-1]


def _turn(store: BlockStore, channel: int, first: int, last: int, change: Change | None) -> None:
    start, stop = store.layout.span(first)[0], store.layout.span(last)[1]
    parts = [_between(store, channel, block, start, stop) for block in range(store.layout.blocks("columns"))]
    row = np.concatenate([part.row for part in parts])
    column = np.concatenate([part.column for part in parts])
    value = np.concatenate([part.value for part in parts])
    variance = _joined([(part.variance, len(part.row)) for part in parts])
    order = np.argsort(row, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=stop - start))])
    for block in range(first, last + 1):
        top, bottom = (place - start for place in store.layout.span(block))
        here = order[ends[top] : ends[bottom]]
        parts_of = (value[here], column[here], ends[top : bottom + 1] - ends[top])
        matrix: Any = scipy.sparse.csr_array(parts_of, shape=store.layout.block_shape(block))
        some = None if variance is None else variance[here]
        if change is not None:
            matrix, some = change(channel, start + top, matrix, some)
        store.put(channel, block, matrix, some, "rows")


def _between(store: BlockStore, channel: int, block: int, start: int, stop: int) -> _Entries:
    """What a block of columns has in rows start .. stop of T; rows are counted from `start`."""
    matrix, variance = store.block(channel, block, "columns")
    places = np.flatnonzero((matrix.indices >= start) & (matrix.indices < stop))
    column = np.searchsorted(matrix.indptr, places, side="right") - 1
    column += store.layout.span(block, "columns")[0]
    row = matrix.indices[places] - start
    some = None if variance is None else variance[places]
    return _Entries(row, column.astype(np.int32), matrix.data[places], some)


def _joined(parts: list[tuple[np.ndarray | None, int]]) -> np.ndarray | None:
    """The variance of all parts: NaN of those that have none; None where none has."""
    if all(part is None for part, _ in parts):
        return None
    return np.concatenate(
        [np.full(size, np.nan, np.float32) if part is None else part for part, size in parts]
    )
