# SPDX-License-Identifier: BSD-3-Clause
"""Everything in a store read again: every checksum, nothing missing, nothing that does not belong."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from ltcl.errors import FileError
from ltcl.store.blocks import aside, creating, entries, extras, nodes

if TYPE_CHECKING:
    from ltcl.store.blocks.block_store import BlockStore


def verify(store: BlockStore) -> None:
    """See `BlockStore.verify`."""
    fresh = type(store).open(store.path)  # the documents as they are now, nothing taken as read
    known = {"zarr.json"}
    for group in creating.groups(fresh.layout):
        known.add(f"{group}/zarr.json")
    for parent in (group for group in creating.groups(fresh.layout) if group != aside.FOLDER):
        for name, versions in aside.versions(fresh.path, parent).items():
            known |= _checked(fresh, parent, name)
            known |= {f"{parent}/{name}.{version}/" for version in versions[:-1]}  # replaced, not yet gone
    _refuse_lost(fresh)
    _refuse_strangers(fresh.path, known)


def _checked(store: BlockStore, parent: str, name: str) -> set[str]:
    """The files of what was committed last under this name, all of them read."""
    if parent.startswith("columns") and store.final:
        return {f"{parent}/{name}.{version}/" for version in aside.versions(store.path, parent)[name]}
    full, due = store.newest(parent, name)
    if parent == "extra":
        extras.read(store.path, full, due)
    else:
        kind, _, channel = parent.rpartition("_")
        number = name.removeprefix("block_")
        if name != f"block_{number}" or not number.isdecimal():
            raise FileError(f"{full} is no block of this store")
        store.block(int(channel), int(number), "rows" if kind == "channel" else "columns")
    arrays = entries.entry(store.path, full, due)
    inner = [file for part, entry in arrays.items() for file in nodes.files_of(f"{full}/{part}", entry)]
    return {f"{full}/zarr.json", *inner}


def _refuse_lost(store: BlockStore) -> None:
    for full in store.finished_with:
        if not (store.path / full).is_dir():
            raise FileError(f"{full} is missing")


def _refuse_strangers(root: Path, known: set[str]) -> None:
    for folder, folders, files in os.walk(root):
        inside = Path(folder).relative_to(root)
        if inside.as_posix() == aside.FOLDER:
            folders.clear()  # what writers are at
        for name in [*folders, *files]:  # a copy: folders that are passed over are taken out
            place = (inside / name).as_posix()
            if (Path(folder) / name).is_symlink():
                raise FileError(f"{place} is a symbolic link; a store has none")
            if f"{place}/" in known:
                folders.remove(name)
            elif name in files and place not in known:
                raise FileError(f"{place} is none of the store's files")
