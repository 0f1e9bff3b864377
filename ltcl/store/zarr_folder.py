# SPDX-License-Identifier: BSD-3-Clause
"""Transports as stores (`block_store`): folders that are read block by block; float64 stays float64.

A compressed transport is kept in extra arrays under the names of `ltcl.transport`, its texts in attributes,
and the names of the arrays there too: other extra arrays are no part of it, and are not read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.errors import FileError
from ltcl.files import fill_folder
from ltcl.store.block_store import BlockStore, Layout, check_place, document, rows_at_once, write_finished
from ltcl.store.record import Parts, Record
from ltcl.store.rows import StoredRows
from ltcl.store.zarr_arrays import Block

_TEXTS, _ARRAYS = "texts", "arrays"


def read(path: Path) -> Record | Parts:
    """The transport in a store, none of it in memory yet; each block is checked once, here."""
    store = BlockStore.open(path)
    if not store.final:
        raise FileError("is a scan that is not finished; finalize it first")
    if store.layout.kind == "compressed":
        texts, names = (store.attributes.get(name) for name in (_TEXTS, _ARRAYS))
        if not isinstance(texts, dict) or not isinstance(names, list):
            raise FileError("is a compressed transport without its texts and the names of its arrays")
        arrays = {name: store.extra(name) for name in names}
        return Parts(arrays | {name: np.array(str(text)) for name, text in texts.items()})
    F, mixing = (store.extra(n) if n in store.extras else None for n in ("first_bounce", "mixing"))
    if F is not None and len(F) == 1:
        F = F[0]
    matrices = tuple(StoredRows(store, channel) for channel in range(store.layout.channels))
    return Record(matrices, store.layout.grid, store.layout.camera_grid, F, mixing)


def write(path: Path, content: Record | Parts) -> None:
    """Write a store in a temporary folder and put it at `path` when it is whole."""
    if content.grid is None:
        raise FileError("a store keeps the grid, and this transport does not tell it; give grid=(h, w)")
    check_place(path, overwrite=True)
    state: dict[str, Any] = {}
    if isinstance(content, Parts):
        layout = Layout(content.shape, content.grid, channels=len(content.first_bounce), kind="compressed")
        extras, state = _arrays(content)
    else:
        dtype = np.result_type(*(T.dtype for T in content.matrices), np.float32).name
        T, rows = content.matrices, rows_at_once(content.shape)
        layout = Layout(content.shape, content.grid, content.camera_grid, len(T), rows, dtype=dtype)
        extras = {} if content.mixing is None else {"mixing": content.mixing}
        if content.first_bounce is not None and not content.bounces_from_diagonal:  # else of T as it is kept
            extras["first_bounce"] = np.atleast_2d(content.first_bounce)
    with fill_folder(path, replace=True) as folder:
        rows = () if isinstance(content, Parts) else _blocks(content, layout)
        files = write_finished(folder, layout, rows, extras.items())
        (folder / "zarr.json").write_bytes(document(layout, {}, state, files))


def conclude(store: BlockStore, parts: Parts, extras: Mapping[str, np.ndarray]) -> None:
    """Close a store of blocks for good as that of a compressed transport, which takes their place.

    `extras` join its extra arrays. Ended at any moment, it goes on from there when called again.
    """
    arrays, state = _arrays(parts)
    sizes: dict[str, Any] = {"shape": parts.shape, "grid": parts.grid, "camera_grid": None}
    layout = replace(store.layout, **sizes, kind="compressed")
    store.finalize(layout=layout, extras={**extras, **arrays}, state=state)


def _blocks(record: Record, layout: Layout) -> Iterator[tuple[int, int, Block]]:
    for channel, T in enumerate(record.matrices):
        for block in range(layout.blocks()):
            start, stop = layout.span(block)
            rows = T.rows(start, stop) if isinstance(T, StoredRows) else T[start:stop]
            yield channel, block, Block(scipy.sparse.csr_array(rows), None)


def _arrays(parts: Parts) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays, and the attributes that hold the rest."""
    texts = {name: str(array) for name, array in parts.arrays.items() if array.dtype.kind in "SU"}
    arrays = {name: parts.arrays[name] for name in sorted(parts.arrays.keys() - texts.keys())}
    return arrays, {_TEXTS: texts, _ARRAYS: list(arrays)}
