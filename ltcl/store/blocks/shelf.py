# SPDX-License-Identifier: BSD-3-Clause
"""`Shelf`: a folder of arrays that grows one by one and is taken away as a whole; of one process at a time.

Each array is committed when `put` returns, as the extra arrays of a store are. What was damaged is not there.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.errors import FileError
from ltcl.store.blocks import aside, creating, extras, nodes, sealed


class Shelf:
    """Arrays by name, in a zarr group at `path`, which is made with `about` where nothing is yet.

    Attributes
    ----------
    path : Path
    about : dict
        Plain JSON, of whoever made it.

    Raises
    ------
    FileError
        Another process has it open; something else is at `path`; it is damaged, or cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with Shelf(Path(tempfile.mkdtemp()) / "arrays", {"made for": "an example"}) as shelf:
    ...     shelf.put("one", np.arange(3))
    ...     shelf.names, shelf.get("one"), shelf.get("two")
    (['one'], array([0, 1, 2]), None)
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self.path = path
        if not os.path.lexists(path):
            _make(path, sealed.seal({"about": dict(about)}, nodes.GROUP))
        self._lock = self._locked()
        try:
            raw = nodes.read_file(path, "zarr.json", sealed.LARGEST)
            self.about: dict[str, Any] = sealed.unseal(raw, "zarr.json")["attributes"].get("about", {})
            aside.tidy(path)
        except (FileError, OSError) as error:
            self.close()
            raise FileError(f"{path}: {error}") from None

    @property
    def names(self) -> list[str]:
        """Of the arrays."""
        return sorted(aside.versions(self.path, "extra"))

    def put(self, name: str, array: np.ndarray) -> None:
        """Commit an array of numbers."""
        extras.write(self.path, name, array)

    def get(self, name: str) -> np.ndarray | None:
        """The array as it was put there, in memory; None where it is not, or not any more."""
        versions = aside.versions(self.path, "extra").get(name)
        if not versions:
            return None
        try:
            return np.array(extras.read(self.path, f"extra/{name}.{versions[-1]}", None))
        except FileError:
            return None

    def remove(self) -> None:
        """Take it away with all that is in it."""
        remove(self.path)

    def close(self) -> None:
        """Leave it to other processes."""
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1

    def __enter__(self) -> Shelf:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _locked(self) -> int:
        if not (self.path / aside.FOLDER).is_dir() or not (self.path / "extra").is_dir():
            raise FileError(f"{self.path}: is there, and was not made by ltcl; it will not be replaced")
        lock = aside.try_lock(self.path / "extra")
        if lock is None:
            raise FileError(f"{self.path}: another process is at work there; one must end first")
        return lock


def remove(path: Path) -> None:
    """Take a shelf away, if there is one: at once, its files a little later."""
    if not (path / aside.FOLDER).is_dir():
        return
    with aside.refusing(path, "the folder"):
        hidden = creating.hidden(path)
        path.rename(hidden)
        shutil.rmtree(hidden, ignore_errors=True)


def _make(path: Path, document: bytes) -> None:
    """An empty one, whole or not at all."""
    with creating.beside(path, overwrite=False) as folder:
        for made in (folder, folder / aside.FOLDER, folder / "extra"):
            made.mkdir()
        nodes.write_file(folder / "extra" / "zarr.json", nodes.PLAIN_GROUP)
        nodes.write_file(folder / "zarr.json", document)
