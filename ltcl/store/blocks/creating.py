# SPDX-License-Identifier: BSD-3-Clause
"""An empty store, there whole or not at all; and a finished folder put in the place of an earlier store."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy

from ltcl.errors import FileError
from ltcl.store.blocks import aside, nodes
from ltcl.store.blocks.layout import Layout


def make(path: Path, layout: Layout, document: bytes, overwrite: bool) -> None:
    """Make an empty store of `layout` at `path`."""
    with beside(path, overwrite) as folder:
        folder.mkdir()
        for group in groups(layout):
            (folder / group).mkdir()
            nodes.write_file(folder / group / "zarr.json", nodes.PLAIN_GROUP)
            aside.flush_folder(folder / group)
        nodes.write_file(folder / "zarr.json", document)
        aside.flush_folder(folder)


def check(path: Path, overwrite: bool) -> None:
    """Refuse at once, before there is anything to keep, a place where no store can be made."""
    with aside.refusing(path, "the store"):
        target = _target(path)
        _refuse_other(path, target, overwrite)
        target.parent.mkdir(parents=True, exist_ok=True)
        probe = hidden(target) if target.exists() else target
        probe.mkdir()
        probe.rmdir()


@contextlib.contextmanager
def beside(path: Path, overwrite: bool) -> Iterator[Path]:
    """The name of a folder to be made, which is renamed to `path` when the block ends well.

    What is at `path` must be a store or an empty folder; it stays where the block fails. (A process that is
    killed between two renames leaves it under a hidden name beside.)
    """
    target = _target(path)
    folder, old = hidden(target), hidden(target)
    with aside.refusing(path, "the store"):
        _refuse_other(path, target, overwrite)
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield folder
            if target.exists():
                target.rename(old)
            try:
                folder.rename(target)
            except BaseException:
                old.rename(target)
                raise
            aside.flush_folder(target.parent)
        finally:
            for leftover in (folder, old):
                shutil.rmtree(leftover, ignore_errors=True)


def groups(layout: Layout) -> list[str]:
    """The plain groups of a store, by name."""
    kinds = ["channel"] if layout.orientation == "rows" else ["channel", "columns"]
    return [aside.FOLDER, "extra", *(f"{kind}_{c}" for kind in kinds for c in range(layout.channels))]


def versions() -> dict[str, str]:
    """Of what makes a store."""
    from ltcl import __version__  # here, because it is set after this module is imported

    return {"ltcl": __version__, "numpy": np.__version__, "scipy": scipy.__version__}


def _target(path: Path) -> Path:
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:  # a name with a NUL in it
        raise FileError(f"{path}: the store cannot be written: {error}") from None


def hidden(target: Path) -> Path:
    """A new name beside it."""
    return target.with_name(f".{target.name[:80]}-{secrets.token_hex(6)}")


def _refuse_other(path: Path, target: Path, overwrite: bool) -> None:
    """Refuse to take the place of anything but an empty folder, or a store where that is asked for."""
    if not os.path.lexists(target) or (target.is_dir() and not any(target.iterdir())):
        return
    if not target.is_dir() or not all((target / name).is_dir() for name in (aside.FOLDER, "extra")):
        raise FileError(f"{path}: is there, and is no store of ltcl; it will not be replaced")
    if not overwrite:
        raise FileError(f"{path}: is there already; open it to go on with it, or give overwrite=True")
