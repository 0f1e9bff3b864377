# SPDX-License-Identifier: BSD-3-Clause
"""Transports as stores (`ltcl.store.blocks`): folders that are read block by block. Values become float32.

A compressed transport is kept in extra arrays under the names of `ltcl.transport`, its texts in attributes,
and the names of the arrays there too: other extra arrays are no part of it, and are not read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import FileError
from ltcl.store.blocks import BlockStore, StoredRows, creating, finishing
from ltcl.store.compressed import Parts
from ltcl.store.record import Record

KEEPS_FIRST_BOUNCE = True
_EXTRAS = ("first_bounce", "mixing")
_TEXTS, _ARRAYS = "texts", "arrays"


def read(path: Path) -> Record | Parts:
    """The transport in a store, none of it in memory yet; each block is checked once, here."""
    store = BlockStore.open(path)
    if store.layout.kind == "compressed":
        texts, names = _told(store)
        arrays = {name: np.array(store.extra(name)) for name in names}
        return Parts(arrays | {name: np.array(str(text)) for name, text in texts.items()})
    if store.orientation == "columns":
        raise FileError("holds columns that have not been turned into rows; finalize it first")
    finishing.refuse_missing(store, "rows")
    F, mixing = (np.array(store.extra(name)) if name in store.extras else None for name in _EXTRAS)
    if F is not None and len(F) == 1:
        F = F[0]
    matrices = tuple(StoredRows(store, channel) for channel in range(store.layout.channels))
    return Record(matrices, store.layout.grid, store.layout.camera_grid, F, mixing)


def write(path: Path, record: Record | Parts) -> None:
    """Write a store beside `path` and put it there when it is whole."""
    with creating.beside(path, overwrite=True) as folder:
        try:
            _filled(folder, record).finalize()
        except FileError as error:
            raise FileError(str(error).replace(str(folder), str(path))) from error


def conclude(store: BlockStore, parts: Parts, beside: Mapping[str, np.ndarray]) -> None:
    """Close a store of blocks for good as that of a compressed transport, which takes their place.

    Arrays `beside` it join the extra arrays. Ended at any moment, it goes on from there when called again;
    the blocks count until all else is there.
    """
    _keep(store, beside)
    _keep_parts(store, parts)
    sizes: dict[str, Any] = {"shape": parts.shape, "grid": parts.grid, "camera_grid": None}
    store.finalize(layout=replace(store.layout, **sizes, kind="compressed"))


def _filled(folder: Path, record: Record | Parts) -> BlockStore:
    if record.grid is None:
        raise FileError("a store keeps the grid, and this transport does not tell it; give grid=(h, w)")
    sizes: dict[str, Any] = {"shape": record.shape, "grid": record.grid, "camera_grid": record.camera_grid}
    if isinstance(record, Parts):
        store = BlockStore.create(folder, **sizes, channels=len(record.first_bounce), kind="compressed")
        _keep_parts(store, record)
    else:
        store = BlockStore.create(folder, **sizes, channels=len(record.matrices))
        for channel, matrix in enumerate(record.matrices):
            for block in range(store.layout.blocks()):
                store.write(channel, block, _rows(matrix, *store.layout.span(block)))
        if record.first_bounce is not None and not record.bounces_from_diagonal:  # else of T as it is kept
            store.extra("first_bounce", np.atleast_2d(record.first_bounce))
        if record.mixing is not None:
            store.extra("mixing", record.mixing)
    return store


def _rows(matrix: Any, start: int, stop: int) -> scipy.sparse.csr_array:
    part = matrix.rows(start, stop) if isinstance(matrix, StoredRows) else matrix[start:stop]
    return scipy.sparse.csr_array(part)


def _keep_parts(store: BlockStore, parts: Parts) -> None:
    texts = {name: str(array) for name, array in parts.arrays.items() if array.dtype.kind in "SU"}
    arrays = {name: parts.arrays[name] for name in sorted(parts.arrays.keys() - texts.keys())}
    _keep(store, arrays)
    store.update(**{_TEXTS: texts, _ARRAYS: list(arrays)})


def _keep(store: BlockStore, arrays: Mapping[str, np.ndarray]) -> None:
    """Commit what an earlier run, which ended here, has not."""
    there = store.extras
    for name, array in arrays.items():
        if name not in there or not _same(store.extra(name), array):
            store.extra(name, array)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and np.array_equal(a, b)


def _told(store: BlockStore) -> tuple[dict[str, Any], list[str]]:
    """Texts, and the names of the arrays."""
    told = store.attributes
    texts, names = told.get(_TEXTS), told.get(_ARRAYS)
    if not isinstance(texts, dict) or not isinstance(names, list):
        raise FileError("is a compressed transport without its texts and the names of its arrays")
    return texts, names
