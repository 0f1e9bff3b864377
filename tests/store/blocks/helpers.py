# SPDX-License-Identifier: BSD-3-Clause
"""Small stores whose every entry is known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import FileError
from ltcl.store import BlockStore


def transport(rows: int = 10, columns: int = 12, channel: int = 0) -> scipy.sparse.csr_array:
    """(rows, columns) float32 with empty rows and a strong diagonal."""
    rng = np.random.default_rng([rows, columns, channel])
    T = np.where(rng.random((rows, columns)) < 0.4, rng.random((rows, columns)), 0.0)
    np.fill_diagonal(T, 2.0 + channel)
    T[3:4] = 0.0
    return scipy.sparse.csr_array(T.astype(np.float32))


def variance(T: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """As many variances, each telling where it belongs."""
    values = np.arange(1, T.nnz + 1, dtype=np.float32)
    return scipy.sparse.csr_array((values, T.indices, T.indptr), shape=T.shape)


def make(path: Path, **options: Any) -> BlockStore:
    """An empty store for `transport()`: blocks of 3, the last one of less."""
    given = {"shape": (10, 12), "grid": (3, 4), "camera_grid": (2, 5), "block_rows": 3, **options}
    return BlockStore.create(path, **given)


def fill(store: BlockStore, *, with_variance: bool = False, final: bool = True) -> BlockStore:
    """Every block of `transport()`, by rows or by columns."""
    for channel in range(store.layout.channels):
        T = transport(*store.layout.shape, channel)
        V = variance(T)
        for block in range(store.layout.blocks(store.orientation)):
            store.write(
                channel, block, part(store, T, block), part(store, V, block) if with_variance else None
            )
    if final:
        store.finalize()
    return store


def part(store: BlockStore, T: scipy.sparse.csr_array, block: int) -> scipy.sparse.csr_array:
    """What of T block `block` takes."""
    start, stop = store.layout.span(block, store.orientation)
    return T[start:stop] if store.orientation == "rows" else scipy.sparse.csr_array(T[:, start:stop].T)


def whole(store: BlockStore, channel: int = 0) -> np.ndarray:
    """T of a store, by its rows."""
    blocks = range(store.layout.blocks())
    return np.concatenate([store.read(channel, block).toarray() for block in blocks])


def refused(path: Path, *parts: str) -> None:
    """Assert that `verify` refuses the store in one line that names it and `parts`."""
    with pytest.raises(FileError) as error:
        BlockStore.open(path).verify()
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    for wanted in parts:
        assert wanted in text
