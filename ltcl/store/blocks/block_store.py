# SPDX-License-Identifier: BSD-3-Clause
"""`BlockStore`: a transport on disk that grows block by block, and is never half of one.

A folder that is a zarr 3 group: `channel_0/block_000000.0` and so on hold rows of T (`entries`),
`columns_0/...` columns that have arrived, `extra/...` small arrays. Every document carries its checksum
(`sealed`) and every folder is renamed into place (`aside`): what is there is whole and was committed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import as_path
from ltcl.store.blocks import aside, creating, entries, extras, finishing, layout, nodes, sealed, verifying
from ltcl.store.blocks.entries import Block
from ltcl.store.blocks.layout import Layout
from ltcl.store.blocks.turning import Change
from ltcl.store.refusals import about

_GROUPS = {"rows": "channel", "columns": "columns"}


class BlockStore:
    """A store of blocks of T, made by `create` or opened by `open`.

    Any number of processes may write distinct blocks at once. A block is committed when `write` returns.

    Attributes
    ----------
    path : Path
    layout : Layout
        Shape, grids, channels, how T is cut.
    provenance : dict
        What `create` was given.

    Examples
    --------
    >>> import tempfile, scipy.sparse
    >>> path = Path(tempfile.mkdtemp()) / "T.zarr"
    >>> store = BlockStore.create(path, shape=(4, 4), grid=(2, 2), block_rows=2)
    >>> store.write(0, 1, scipy.sparse.csr_array([[0.0, 0.0, 0.5, 0.0], [0.0, 0.1, 0.0, 0.5]]))
    >>> sorted(BlockStore.open(path).written), store.missing()
    ([(0, 1)], [(0, 0)])
    """

    def __init__(self, path: Path, mode: str) -> None:
        self.path, self.mode = path, mode
        document = self._document()["attributes"]
        self.layout = Layout.from_json(document.get("ltcl"))
        self.provenance: dict[str, Any] = document.get("provenance", {})
        self._final: dict[str, str] | None = document.get("final")
        self._verified: set[str] = set()

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        shape: tuple[int, int],
        grid: tuple[int, int],
        camera_grid: tuple[int, int] | None = None,
        channels: int = 1,
        block_rows: int | None = None,
        orientation: str = "rows",
        provenance: Mapping[str, Any] | None = None,
        overwrite: bool = False,
        kind: str = "blocks",
    ) -> BlockStore:
        """An empty store at `path`.

        Parameters
        ----------
        path
            Where nothing is yet, or a store to `overwrite`.
        shape : (M, N)
        grid, camera_grid : (h, w)
        channels : 1 or 3
        block_rows : int, optional
            Rows (columns) of a block; about 64 MiB of full rows when not given.
        orientation : "rows" or "columns"
            "columns": `write` takes columns of T, each as a row of (columns, M), and `finalize` turns them.
        provenance : dict
            Plain JSON: rig, settings, hashes; the versions of ltcl, NumPy and SciPy join it.

        Raises
        ------
        InputError
            Sizes that do not fit, provenance that is no JSON.
        FileError
            Something is at `path`, or it cannot be written.
        """
        path = as_path(path)
        shape, grid = checks.grid("shape", shape), checks.grid("grid", grid)
        camera_grid = None if camera_grid is None else checks.grid("camera_grid", camera_grid)
        rows = layout.rows_at_once(shape) if block_rows is None else block_rows
        told = Layout(shape, grid, camera_grid, channels, rows, orientation, kind)
        own = {"versions": creating.versions()} | dict(provenance or {})
        attributes = {"ltcl": told.to_json(), "provenance": own, "state": {}}
        creating.make(path, told, sealed.seal(attributes, nodes.GROUP), overwrite)
        return cls(path, "a")

    @classmethod
    def open(cls, path: str | os.PathLike[str], mode: str = "r") -> BlockStore:
        """Open a store, "r" to read or "a" to write as well; blocks are checked when they are read."""
        path = as_path(path)
        if mode not in ("r", "a"):
            raise InputError(f"mode is {mode!r}; it must be 'r' or 'a'")
        if not path.is_dir():
            raise FileError(f"{path}: {'is no folder, as a store is' if path.exists() else 'no such folder'}")
        with about(path):
            store = cls(path, mode)
            for group in creating.groups(store.layout):
                if nodes.read_file(path, f"{group}/zarr.json", 1 << 16) != nodes.PLAIN_GROUP:
                    raise FileError(f"{group}/zarr.json is damaged: it must be that of a plain group")
        return store

    def __repr__(self) -> str:
        (rows, columns), state = (
            self.layout.shape,
            "final" if self.final else f"{len(self.written)} blocks written",
        )
        return f"<ltcl BlockStore {rows} x {columns}, {self.layout.channels} channel(s), {state}>"

    @property
    def final(self) -> bool:
        """Whether `finalize` has ended: all blocks are there, and none will be written any more."""
        return self._final is not None

    @property
    def finished_with(self) -> Mapping[str, str]:
        """Checksum of the entry of every block and extra array by its full name; empty unless `final`."""
        return self._final or {}

    @property
    def orientation(self) -> str:
        """How blocks are held: as they arrive, and by rows once the store is final."""
        return "rows" if self.final else self.layout.orientation

    @property
    def written(self) -> frozenset[tuple[int, int]]:
        """(channel, block) of all that is committed; asked of the disk, so other writers' blocks count."""
        return self.held(self.orientation)

    def held(self, orientation: str) -> frozenset[tuple[int, int]]:
        """`written`, of rows or of columns."""
        found = set()
        for channel in range(self.layout.channels):
            for name in aside.versions(self.path, f"{_GROUPS[orientation]}_{channel}"):
                number = name.removeprefix("block_")
                if re.fullmatch(r"\d{6,9}", number) and int(number) < self.layout.blocks(orientation):
                    found.add((channel, int(number)))
        return frozenset(found)

    def missing(self, orientation: str | None = None) -> list[tuple[int, int]]:
        """(channel, block) of all that is not committed, in order."""
        orientation = orientation or self.orientation
        if self.layout.kind != "blocks":
            return []
        there = self.held(orientation)
        every = ((c, b) for c in range(self.layout.channels) for b in range(self.layout.blocks(orientation)))
        return [which for which in every if which not in there]

    def write(self, channel: int, block: int, matrix: Any, variance: Any = None) -> None:
        """Commit a block: when this returns it is on the disk, whole; if it raises, what was there still is.

        Parameters
        ----------
        channel, block : int
            One that is there already is replaced.
        matrix : scipy.sparse, (rows, N)
            Rows of T; of a store by "columns" (columns, M), each row of it a column of T. Kept as float32.
        variance : sparse of the same pattern, or (nnz,), optional
            Of each stored entry; NaN where unknown.

        Raises
        ------
        InputError
            Another shape, NaN, no such block.
        FileError
            The store is final or open to read only, or the disk is full.
        """
        self._writable()
        self.put(channel, block, matrix, variance, self.layout.orientation)

    def put(self, channel: int, block: int, matrix: Any, variance: Any, orientation: str) -> None:
        """`write` of rows, or of columns."""
        parent, name = self._place(channel, block, orientation)
        checked = entries.check(matrix, variance, self.layout.block_shape(block, orientation))
        with aside.placed(self.path, parent, name) as folder:
            entries.write(folder, checked)

    def read(self, channel: int, block: int) -> scipy.sparse.csr_array:
        """The block as `write` took it, memory-mapped; its checksums are compared at the first call."""
        return self.block(channel, block, self.orientation).matrix

    def variance(self, channel: int, block: int) -> np.ndarray | None:
        """Variance (nnz,) of the entries of a block; None where none was written."""
        return self.block(channel, block, self.orientation).variance

    def block(self, channel: int, block: int, orientation: str) -> Block:
        """A block of rows or columns with its variance."""
        parent, name = self._place(channel, block, orientation)
        with about(self.path):
            full, due = self.newest(parent, name)
            shape, first = self.layout.block_shape(block, orientation), full not in self._verified
            found = entries.read(self.path, full, shape, due, verify=first)
        self._verified.add(full)
        return found

    def newest(self, parent: str, name: str) -> tuple[str, str | None]:
        """The full name of what was committed last, and the checksum it was finished with."""
        found = aside.versions(self.path, parent).get(name)
        if not found:
            raise FileError(f"{parent}/{name} is missing")
        full = f"{parent}/{name}.{found[-1]}"
        if self._final is None:
            return full, None
        if full not in self._final:
            raise FileError(f"{full} is none that the store was finished with")
        return full, self._final[full]

    def extra(self, name: str, array: Any = None) -> np.ndarray:
        """A small array by name: committed where `array` is given, else read (memory-mapped, checked)."""
        extras.check_name(name)
        if array is not None:
            self._writable()
            extras.write(self.path, name, np.asarray(array))
            return np.asarray(array)
        with about(self.path):
            full, due = self.newest("extra", name)
            return extras.read(self.path, full, due)

    @property
    def extras(self) -> list[str]:
        """Names of the extra arrays."""
        return sorted(aside.versions(self.path, "extra"))

    @property
    def attributes(self) -> dict[str, Any]:
        """Whatever the writer keeps with the store, plain JSON; read from the disk. See `update`."""
        with about(self.path):
            return dict(self._document()["attributes"].get("state", {}))

    def update(self, **attributes: Any) -> None:
        """Change some of the `attributes`, at once or not at all; other processes' changes are kept."""
        self._writable()
        with aside.locked(self.path):
            state = self.attributes | attributes
            self.rewrite(state=state)

    def rewrite(self, **parts: Any) -> None:
        """Replace parts of the store's own document; to be called under `aside.locked`."""
        with about(self.path):
            attributes = self._document()["attributes"]
        del attributes["checksum"]
        aside.replace_document(self.path, "zarr.json", sealed.seal(attributes | parts, nodes.GROUP))
        self._final = (attributes | parts).get("final")
        self.layout = Layout.from_json((attributes | parts).get("ltcl"))

    def finalize(
        self,
        *,
        memory: int | None = None,
        sigmas: float = 0.0,
        layout: Layout | None = None,
        change: Change | None = None,
    ) -> None:
        """Turn columns into rows, out of core; find the first bounce; close the store for good.

        Ended at any moment, it goes on from there when called again. Must not run beside writers.

        Parameters
        ----------
        memory : int, optional
            Bytes for the entries that are turned at once; 256 MiB when not given.
        sigmas : float
            Standard deviations by which the diagonal has to be above 0 to be a first bounce.
        layout : Layout, optional
            Of the store from then on, whose extra arrays take the place of all blocks ("compressed").
        change : function, optional
            Of channel, first row, rows (rows, N) and the variance of their entries: what is committed of the
            two, wherever columns are turned. The same in every call.

        Raises
        ------
        FileError
            Blocks are missing: which ones is said. Or the disk is full.
        """
        if self.mode != "a":
            self._writable()
        with about(self.path):
            finishing.finish(self, memory, sigmas, layout or self.layout, change)

    def verify(self) -> None:
        """Read everything and compare all checksums; the first thing that is wrong is raised as FileError."""
        with about(self.path):
            verifying.verify(self)

    def _place(self, channel: int, block: int, orientation: str) -> tuple[str, str]:
        blocks = self.layout.blocks(orientation)
        for name, value, most in (("channel", channel, self.layout.channels), ("block", block, blocks)):
            whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
            if not whole or not 0 <= value < most:
                raise InputError(f"{name} is {value!r}; it must be in 0..{most - 1}")
        return f"{_GROUPS[orientation]}_{channel}", f"block_{block:06d}"

    def _writable(self) -> None:
        if self.mode != "a":
            raise FileError(f"{self.path}: is open to read; open it with mode 'a' to write")
        if self.final:
            raise FileError(f"{self.path}: is final; nothing is written to it any more")

    def _document(self) -> dict[str, Any]:
        document = sealed.unseal(nodes.read_file(self.path, "zarr.json", sealed.LARGEST), "zarr.json")
        layout.refuse_parts(document["attributes"])
        return document
