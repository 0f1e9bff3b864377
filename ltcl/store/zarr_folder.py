# SPDX-License-Identifier: BSD-3-Clause
"""Transports as stores (`ltcl.store.blocks`): folders that are read block by block. Values become float32.

A compressed transport is kept in extra arrays under the names of `ltcl.parts`, its texts in the attributes.
"""

from __future__ import annotations

from collections.abc import Mapping
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
_TEXTS = "texts"


def read(path: Path) -> Record | Parts:
    """The transport in a store, none of it in memory yet; each block is checked once, here."""
    store = BlockStore.open(path)
    if store.layout.kind == "compressed":
        texts = {name: np.array(str(text)) for name, text in _texts(store).items()}
        return Parts({name: np.array(store.extra(name)) for name in store.extras} | texts)
    if store.orientation == "columns":
        raise FileError("holds columns that have not been turned into rows; finalize it first")
    finishing.refuse_missing(store, "rows")
    F, mixing = (np.array(store.extra(name)) if name in store.extras else None for name in _EXTRAS)
    if F is not None and len(F) == 1:
        F = F[0]
    matrices = tuple(StoredRows(store, channel) for channel in range(store.layout.channels))
    return Record(matrices, store.layout.grid, store.layout.camera_grid, F, mixing)


def write(
    path: Path,
    record: Record | Parts,
    *,
    extras: Mapping[str, np.ndarray] | None = None,
    attributes: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write a store beside `path` and put it there when it is whole.

    `extras` join the extra arrays, `attributes` and `provenance` are those of a `BlockStore`.
    """
    with creating.beside(path, overwrite=True) as folder:
        try:
            store = _filled(folder, record, provenance)
            for name, array in (extras or {}).items():
                store.extra(name, array)
            if attributes:
                store.update(**attributes)
            store.finalize()
        except FileError as error:
            raise FileError(str(error).replace(str(folder), str(path))) from error


def _filled(folder: Path, record: Record | Parts, provenance: Mapping[str, Any] | None) -> BlockStore:
    if record.grid is None:
        raise FileError("a store keeps the grid, and this transport does not tell it; give grid=(h, w)")
    sizes: dict[str, Any] = {"shape": record.shape, "grid": record.grid, "camera_grid": record.camera_grid}
    sizes["provenance"] = provenance
    if isinstance(record, Parts):
        store = BlockStore.create(folder, **sizes, channels=len(record.first_bounce), kind="compressed")
        texts = {name: str(array) for name, array in record.arrays.items() if array.dtype.kind in "SU"}
        for name in sorted(record.arrays.keys() - texts.keys()):
            store.extra(name, record.arrays[name])
        store.update(**{_TEXTS: texts})
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


def _texts(store: BlockStore) -> dict[str, Any]:
    texts = store.attributes.get(_TEXTS)
    if not isinstance(texts, dict):
        raise FileError("is a compressed transport without its texts")
    return texts
