# SPDX-License-Identifier: BSD-3-Clause
"""How a store is closed: columns turned, first bounce found, every entry's checksum written down.

Each step can be repeated, and does nothing where it was done before; the store is final with the rename of
its document, which then names every block and extra array with its checksum. Only then do the columns go.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse

from ltcl import first_bounce
from ltcl.errors import FileError
from ltcl.store.blocks import aside, nodes, sealed, turning
from ltcl.store.blocks.layout import Layout

if TYPE_CHECKING:
    from ltcl.store.blocks.block_store import BlockStore

_MEMORY = 1 << 28


def finish(
    store: BlockStore,
    memory: int | None,
    sigmas: float,
    layout: Layout,
    change: turning.Change | None = None,
) -> None:
    """See `BlockStore.finalize`."""
    if not store.final:
        if layout.kind == "blocks":
            _finish_blocks(store, memory, sigmas, change)
        with aside.locked(store.path):
            store.rewrite(ltcl=layout.to_json(), final=_sums(store))
    _clear(store)


def _finish_blocks(
    store: BlockStore, memory: int | None, sigmas: float, change: turning.Change | None
) -> None:
    if store.layout.orientation == "columns":
        if store.missing("rows"):
            refuse_missing(store, "columns")
        turning.turn(store, _MEMORY if memory is None else memory, change)
    refuse_missing(store, "rows")
    if store.layout.is_square and "first_bounce" not in store.extras:
        _find_first_bounce(store, sigmas)


def refuse_missing(store: BlockStore, orientation: str) -> None:
    """Refuse a store in which blocks are missing, and say which."""
    missing = store.missing(orientation)
    if missing:
        raise FileError(f"lacks {_listed(missing)} of {orientation}; resume the acquisition")


def _listed(missing: Sequence[tuple[int, int]]) -> str:
    named = ", ".join(f"({c}, {b})" for c, b in missing[:6])
    more = f" and {len(missing) - 6} more" if len(missing) > 6 else ""
    return f"{len(missing)} block(s) (channel, block) {named}{more}"


def _find_first_bounce(store: BlockStore, sigmas: float) -> None:
    """The diagonal of T, and which projector pixels have none."""
    F = np.zeros((store.layout.channels, store.layout.shape[1]))
    for channel in range(store.layout.channels):
        for block in range(store.layout.blocks()):
            start, stop = store.layout.span(block)
            T, variance = store.block(channel, block, "rows")
            F[channel, start:stop] = T.diagonal(start)
            if variance is not None and sigmas > 0:
                V = scipy.sparse.csr_array((variance, T.indices, T.indptr), shape=T.shape)
                F[channel, start:stop] = first_bounce.certain(T.diagonal(start), V.diagonal(start), sigmas)
    if "masked" not in store.extras:  # of a run that was killed between the two
        store.extra("masked", np.asarray((F <= 0).any(axis=0)))
    store.extra("first_bounce", F)


def _sums(store: BlockStore) -> dict[str, str]:
    """The checksum of the entry of every block of rows and every extra array, by full name."""
    found = {}
    for parent in ("extra", *(f"channel_{c}" for c in range(store.layout.channels))):
        for name, versions in sorted(aside.versions(store.path, parent).items()):
            full = f"{parent}/{name}.{versions[-1]}"
            raw = nodes.read_file(store.path, f"{full}/zarr.json", 1 << 16)
            sealed.unseal(raw, f"{full}/zarr.json")
            found[full] = sealed.checksum(raw)
    return found


def _clear(store: BlockStore) -> None:
    """Remove columns that were turned, versions that were replaced, and what killed writers left."""
    kinds = ["channel"] if store.layout.orientation == "rows" else ["channel", "columns"]
    for parent in ("extra", *(f"{kind}_{c}" for kind in kinds for c in range(store.layout.channels))):
        for name, versions in aside.versions(store.path, parent).items():
            for version in versions if parent.startswith("columns") else versions[:-1]:
                aside.remove(store.path, f"{parent}/{name}.{version}")
    aside.tidy(store.path)
