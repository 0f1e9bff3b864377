# SPDX-License-Identifier: BSD-3-Clause
"""`BlockStore`: a transport on disk that grows by batches of columns, and is never half of one.

A growing store is a folder of `zarr.json` (sizes, provenance, attributes, with a checksum) and `log/`, one
checksummed .npz a batch or small array, each written in a temporary and renamed. `finalize` writes rows of T
next to the log as zarr arrays; with the rename of the document, which then names every file with its SHA-256,
the store is final, and only then the log goes. Whenever a process ends, what was committed stays, and doing
the same again makes the same files.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
import scipy.sparse

from ltcl import checks, first_bounce
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.files import as_path, fill_folder, flush_tree, locked, replace_file, restore, sweep
from ltcl.store import zarr_arrays
from ltcl.store.record import CSR, Parts, Record, StoredRows, about
from ltcl.store.zarr_arrays import Layout, ZarrArrays, write_group, write_rows

_SCHEMA = 2
_PER_ENTRY = 64  # bytes: places, values and variance, as cut, joined and turned
_CHECKSUM = 64  # bytes at the end of a file of a log
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,120}")


class Block(NamedTuple):
    """Rows (or columns) of T, and the variance of each stored entry where it is known."""

    matrix: scipy.sparse.csr_array
    variance: np.ndarray | None


class ArrayLog:
    """Sets of arrays by name in the folder `path`, which the first makes: an .npz and its SHA-256 each."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def names(self) -> list[str]:
        """Of what is committed, by whatever process."""
        with about(self.path):
            files = os.listdir(self.path) if self.path.exists() else []
        return sorted(file[:-4] for file in files if file.endswith(".npz") and _NAME.fullmatch(file[:-4]))

    def put(self, name: str, **arrays: Any) -> None:
        """Commit arrays of numbers or texts; what has that name already is replaced whole, or stays."""
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            allowed = "letters, digits, _, - and . with a letter first"
            raise InputError(f"name is {name!r:.60}; it must be {allowed}")
        if wrong := [array for array in map(np.asarray, arrays.values()) if array.dtype.kind not in "fiubU"]:
            raise InputTypeError(f"{name} holds {wrong[0].dtype}; it must hold numbers")
        stream = io.BytesIO()
        np.savez(stream, **arrays)
        stream.write(hashlib.sha256(stream.getbuffer()).hexdigest().encode())
        with replace_file(self.path / f"{name}.npz") as temporary:
            temporary.write_bytes(stream.getbuffer())

    def get(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name, whose checksum is compared."""
        with about(self.path, reading=True):
            raw = zarr_arrays.read_file(self.path, f"{name}.npz")
            if hashlib.sha256(raw[:-_CHECKSUM]).hexdigest().encode() != raw[-_CHECKSUM:]:
                raise FileError(f"{name}.npz is damaged: its checksum is not that of its bytes")
            with np.load(io.BytesIO(raw), allow_pickle=False) as arrays:
                return dict(arrays)

    def verify(self) -> None:
        """Read all."""
        for name in self.names:
            self.get(name)


class BlockStore:
    """A transport that grows by batches of its columns, made by `create` or opened by `open`.

    Any number of processes may write at once; what they write is committed when the call returns. `final`
    tells whether `finalize` has ended: all of T is there by rows, and nothing will be written any more.

    Examples
    --------
    >>> import tempfile, scipy.sparse
    >>> store = BlockStore.create(tempfile.mkdtemp(), shape=(4, 4), grid=(2, 2), block_rows=2)
    >>> store.write(0, 1, scipy.sparse.eye_array(2, 4, k=2))
    >>> sorted(store.written), store.missing()
    ([(0, 1)], [(0, 0)])
    """

    def __init__(self, path: Path, mode: str) -> None:
        self.path, self.mode, self._log = path, mode, ArrayLog(path / "log")
        self._read_document()

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
        provenance: Mapping[str, Any] | None = None,
        overwrite: bool = False,
    ) -> BlockStore:
        """An empty store at `path`, where nothing is yet, or a store to `overwrite`.

        Sizes are those of `Layout`; a batch has `block_rows` columns. `provenance` is plain JSON, such as rig
        and settings; the versions of ltcl, NumPy and SciPy join it.
        """
        path = as_path(path)
        layout = Layout(shape, grid, camera_grid, channels, block_rows)
        raw = _document(layout, provenance or {}, {})
        check_place(path, overwrite)
        with fill_folder(path, replace=True) as folder:
            (folder / "zarr.json").write_bytes(raw)
        return cls(path, "a")

    @classmethod
    def open(cls, path: str | os.PathLike[str], mode: str = "r") -> BlockStore:
        """Open a store, "r" to read or "a" to write as well; blocks are checked when they are read."""
        path = as_path(path)
        checks.one_of("mode", mode, ("r", "a"))
        with about(path):
            restore(Path(os.path.realpath(path)))
            if not path.is_dir():
                raise FileError("is no folder, as a store is" if path.exists() else "no such folder")
            store = cls(path, mode)
            if mode == "a":
                for folder in (path.parent, path, store._log.path):
                    sweep(folder)
                store._clear()
        return store

    @property
    def written(self) -> frozenset[tuple[int, int]]:
        """(channel, block) of all that is committed; asked of the disk, so other writers' blocks count."""
        pattern = re.compile(rf"{self._orientation}_(\d)\.(\d+)")
        return frozenset((int(m[1]), int(m[2])) for m in map(pattern.fullmatch, self._arrays.names) if m)

    def missing(self) -> list[tuple[int, int]]:
        """(channel, block) of all that is not committed, in order."""
        if self.layout.kind != "blocks":
            return []
        written, blocks = self.written, self.layout.blocks(self._orientation)
        every = ((c, b) for c in range(self.layout.channels) for b in range(blocks))
        return [which for which in every if which not in written]

    def write(self, channel: int, block: int, matrix: Any, variance: Any = None) -> None:
        """Commit a batch: when this returns it is on the disk, whole; if it raises, what was there still is.

        Each row of `matrix`, sparse (columns, M), is a column of T, kept as float32; `variance` (nnz,) is
        that of its entries, NaN where unknown.
        """
        name = self._name(channel, block)
        C = _checked(matrix, variance, self.layout.block_shape(block, "columns"))
        arrays = {array: getattr(C.matrix, array) for array in CSR}
        with self._writing():
            self._log.put(name, **arrays, **({} if C.variance is None else {"variance": C.variance}))

    def block(self, channel: int, block: int) -> Block:
        """Rows of T of a final store, else a batch as `write` took it; its checksums are compared."""
        name, shape = self._name(channel, block), self.layout.block_shape(block, self._orientation)
        with about(self.path, reading=True):
            arrays = self._arrays.get(name)
            data, indices, indptr = (arrays[array] for array in CSR)
            checks.compressed(name, indptr, indices, data, shape)
            matrix = scipy.sparse.csr_array((data, indices, indptr), shape=shape)
            if not matrix.has_canonical_format:
                raise FileError(f"{name} has indices that do not ascend")
            return Block(matrix, arrays.get("variance"))

    def extra(self, name: str, array: Any = None) -> np.ndarray:
        """A small array by name: committed where `array` is given, else read and checked."""
        if array is not None:
            array = checks.real(name, array)
            with self._writing():
                self._log.put(f"extra.{name}", array=array)
            return array
        with about(self.path, reading=True):
            return self._arrays.get(f"extra.{name}")["array"]

    @property
    def extras(self) -> list[str]:
        """Names of the extra arrays."""
        return [n.removeprefix("extra.") for n in self._arrays.names if n.startswith("extra.")]

    @property
    def attributes(self) -> dict[str, Any]:
        """Whatever the writer keeps with the store, plain JSON; read from the disk. See `update`."""
        return self._read_document()

    def update(self, **attributes: Any) -> None:
        """Change some of the `attributes`, at once or not at all; other processes' changes are kept."""
        with self._writing():
            self._write_document(self.layout, self.attributes | attributes)

    def finalize(
        self,
        *,
        sigmas: float = 0.0,
        change: Callable[[int, int, Any, Any], tuple[Any, Any]] | None = None,
        compressed: Parts | None = None,
        memory: int = 1 << 28,
    ) -> None:
        """Turn columns into rows, out of core; find the first bounce; close the store for good.

        Ended at any moment, it makes the same when called again. FileError names blocks that are missing.
        The diagonal is a first bounce where it is above 0 by `sigmas` standard deviations; `change`, of
        channel, first row, rows (rows, N) and the variance of their entries, returns the last two anew. A
        transport `compressed` takes the place of all columns. `memory` is bytes for what is turned at once.
        """
        with self._writing(finished=True):
            state = self._read_document()
            if not self.final:
                extras = {name: self.extra(name) for name in self.extras}
                layout, rows = self.layout, self._rows(memory, change)
                if compressed is not None:
                    layout, arrays, texts = _compressed(compressed, layout.block_rows)
                    rows, extras, state = (), extras | arrays, state | texts
                elif missing := self.missing():
                    numbers = ", ".join(map(str, missing[:6])) + (" ..." if len(missing) > 6 else "")
                    text = f"lacks {len(missing)} block(s) (channel, block) {numbers}; resume the scan"
                    raise FileError(text)
                files = _write_finished(self.path, layout, rows, extras, sigmas)
                self._write_document(layout, state, files=files)
        self._clear()

    def verify(self) -> None:
        """Read everything and compare all checksums; the first thing that is wrong is raised as FileError."""
        self._read_document()
        with about(self.path, reading=True):
            self._arrays.verify()

    def _name(self, channel: int, block: int) -> str:
        checks.count("channel", channel, least=0, most=self.layout.channels - 1)
        checks.count("block", block, least=0, most=self.layout.blocks(self._orientation) - 1)
        return f"{self._orientation}_{channel}.{block:06d}"

    @contextlib.contextmanager
    def _writing(self, *, finished: bool = False) -> Iterator[None]:
        """One process at a time; none once the store is final, unless `finished`."""
        if self.mode != "a":
            raise FileError(f"{self.path}: is open to read; open it with mode 'a' to write")
        with about(self.path), locked(self.path):
            self._read_document()
            if self.final and not finished:
                raise FileError("is final; nothing is written to it any more")
            yield

    def _read_document(self) -> dict[str, Any]:
        """Everything that zarr.json says; returns the attributes of the writer."""
        with about(self.path, reading=True):
            attributes = zarr_arrays.unseal(zarr_arrays.read_file(self.path, "zarr.json"), "zarr.json")
            sizes, files = dict(attributes["ltcl"]), attributes.get("files")
            if (schema := sizes.pop("schema")) not in (1, _SCHEMA):
                raise FileError(f"schema is {schema!r:.40}; this ltcl reads 1 and {_SCHEMA}")
            if schema == 1:
                files = zarr_arrays.manifest_1(self.path, attributes.get("final") or {})
            sizes.pop("orientation", None)  # of earlier stores
            self.layout, self.provenance = Layout(**sizes), attributes["provenance"]
            self._arrays = self._log if files is None else ZarrArrays(self.path, files)
            self.final = files is not None
            self._orientation = "rows" if self.final else "columns"
            return attributes["state"]

    def _write_document(self, layout: Layout, state: Mapping[str, Any], **files: Any) -> None:
        raw = _document(layout, self.provenance, state, **files)
        with replace_file(self.path / "zarr.json") as temporary:
            temporary.write_bytes(raw)
        self._read_document()

    def _clear(self) -> None:
        if self.final:
            shutil.rmtree(self._log.path, ignore_errors=True)

    def _rows(self, memory: int, change: Callable | None) -> Iterator[tuple[int, int, Block]]:
        """All blocks of rows; as many as fit the memory are gathered in a pass over the columns."""
        span, batches = self.layout.span, range(self.layout.blocks("columns"))
        for channel in range(self.layout.channels):
            entries = np.zeros(self.layout.blocks(), np.int64)
            for batch in batches:
                rows = self.block(channel, batch).matrix.indices // self.layout.block_rows
                entries += np.bincount(rows, minlength=len(entries))
            passes = np.cumsum(entries) * _PER_ENTRY // memory
            for number in np.unique(passes):
                blocks, columns, known = np.flatnonzero(passes == number).tolist(), [], False
                first, stop = span(blocks[0])[0], span(blocks[-1])[1]
                for C, variance in (self.block(channel, batch) for batch in batches):
                    known |= variance is not None
                    data = np.empty(C.nnz, np.complex64)  # T + i V, NaN where V is unknown
                    data.real, data.imag = C.data, np.nan if variance is None else variance
                    columns.append(
                        scipy.sparse.csr_array((data, C.indices, C.indptr), C.shape)[:, first:stop]
                    )
                T = scipy.sparse.vstack(columns, "csr").T.tocsr()
                for block in blocks:
                    R = T[span(block)[0] - first : span(block)[1] - first]
                    rows, variance = R.real, R.data.imag.copy() if known else None
                    if change is not None:
                        rows, variance = change(channel, span(block)[0], rows, variance)
                    yield channel, block, _checked(rows, variance, self.layout.block_shape(block))


def read(path: Path) -> Record | Parts:
    """The transport in a store, none of it in memory yet; each block is checked once, here."""
    store = BlockStore.open(path)
    if not store.final:
        raise FileError("is a scan that is not finished; finalize it first")
    if store.layout.kind == "compressed":
        arrays = {name: store.extra(name) for name in store.attributes["arrays"]}  # others are no part of it
        return Parts(arrays | {name: np.array(str(text)) for name, text in store.attributes["texts"].items()})
    F, mixing = (store.extra(n) if n in store.extras else None for n in ("first_bounce", "mixing"))
    matrices = tuple(StoredRows(store, channel) for channel in range(store.layout.channels))
    F = F[0] if F is not None and len(F) == 1 else F
    return Record(matrices, store.layout.grid, store.layout.camera_grid, F, mixing)


def write(path: Path, content: Record | Parts) -> None:
    """Write a store in a temporary folder and put it at `path` when it is whole; float64 stays float64."""
    if content.grid is None:
        raise FileError("a store keeps the grid, which is unknown for this transport; give grid=(h, w)")
    check_place(path, overwrite=True)
    rows, state = (), {}
    if isinstance(content, Parts):
        layout, extras, state = _compressed(content)
    else:
        T, sizes = content.matrices, (content.shape, content.grid, content.camera_grid)
        layout = Layout(*sizes, len(T), dtype=np.result_type(*(M.dtype for M in T), np.float32).name)
        known, rows = {"first_bounce": content.first_bounce, "mixing": content.mixing}, _blocks(T, layout)
        extras = {name: np.atleast_2d(array) for name, array in known.items() if array is not None}
    with fill_folder(path, replace=True) as folder:
        files = _write_finished(folder, layout, rows, extras)
        (folder / "zarr.json").write_bytes(_document(layout, {}, state, files=files))


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse at once, before there is anything to keep, a place where no store can be made."""
    with about(path):
        target = Path(os.path.realpath(path))
        restore(target)
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            own = target / "zarr.json"
            if not own.is_file() or not own.read_bytes().startswith(zarr_arrays.START):
                raise FileError("is there, and is no store of ltcl; it will not be replaced")
            if not overwrite:
                raise FileError("is there already; open it to go on with it, or give overwrite=True")
        parent = next(folder for folder in target.parents if folder.exists())
        if not os.access(parent, os.W_OK | os.X_OK):
            raise FileError(f"cannot be written: {parent} may not be written")


def _blocks(matrices: Iterable[Any], layout: Layout) -> Iterator[tuple[int, int, Block]]:
    for channel, T in enumerate(matrices):
        for block in range(layout.blocks()):
            start, stop = layout.span(block)
            rows = T.rows(start, stop) if isinstance(T, StoredRows) else T[start:stop]
            yield channel, block, Block(scipy.sparse.csr_array(rows), None)


def _compressed(parts: Parts, block_rows: int = 1) -> tuple[Layout, dict[str, Any], dict[str, Any]]:
    """Of the store of `parts`: layout, arrays, and the attributes that hold the rest."""
    sizes: dict[str, Any] = {"channels": len(parts.first_bounce), "block_rows": block_rows}
    texts = {name: str(array) for name, array in parts.arrays.items() if array.dtype.kind in "SU"}
    arrays = {name: parts.arrays[name] for name in sorted(parts.arrays.keys() - texts.keys())}
    layout = Layout(parts.shape, parts.grid, **sizes, kind="compressed")
    return layout, arrays, {"texts": texts, "arrays": list(arrays)}


def _write_finished(
    root: Path,
    layout: Layout,
    rows: Iterable[tuple[int, int, Block]],
    extras: Mapping[str, np.ndarray],
    sigmas: float = 0.0,
) -> dict[str, str]:
    """Write T and all small arrays by zarr into `root`, flushed; returns their manifest."""
    groups = ["extra", *(f"channel_{c}" for c in range(layout.channels))]
    for group in groups:
        shutil.rmtree(root / group, ignore_errors=True)  # of a process that ended here
        write_group(root / group, {}, {})
    F = np.zeros((layout.channels, layout.shape[1]))
    for channel, number, (T, variance) in rows:
        write_rows(root / f"channel_{channel}/block_{number:06d}.0", T, variance, layout.dtype)
        if layout.is_square:
            start, stop = layout.span(number)
            F[channel, start:stop] = T.diagonal(start)
            if variance is not None and sigmas > 0:
                V = scipy.sparse.csr_array((variance, T.indices, T.indptr), shape=T.shape).diagonal(start)
                F[channel, start:stop] = first_bounce.certain(T.diagonal(start), V, sigmas)
    if layout.kind == "blocks" and layout.is_square:
        extras = {"first_bounce": F, **extras}
    for name, array in extras.items():
        write_group(root / "extra" / f"{name}.0", {"array": np.asarray(array)}, {})
    for group in groups:
        flush_tree(root / group)
    return zarr_arrays.manifest(root, groups)


def _document(layout: Layout, provenance: Mapping[str, Any], state: Mapping[str, Any], **files: Any) -> bytes:
    """The zarr.json of a store; `files` of a final one."""
    from ltcl import __version__  # here, because it is set after this module is imported

    versions = {"ltcl": __version__, "numpy": np.__version__, "scipy": scipy.__version__}
    known = {"provenance": {"versions": versions, **provenance}, "state": dict(state), **files}
    return zarr_arrays.seal({"ltcl": {"schema": _SCHEMA, **asdict(layout)}, **known})


def _checked(matrix: Any, variance: Any, shape: tuple[int, int]) -> Block:
    """What is to be written, as float32; refused before anything is."""
    matrix = checks.csr("matrix", matrix)
    checks.shape("matrix", matrix, shape)
    with np.errstate(over="ignore"):
        values = checks.finite("matrix as float32", matrix.data.astype(np.float32))
    if variance is not None:
        variance = checks.shape("variance", checks.real("variance", variance), (matrix.nnz,))
        if np.any(variance < 0) or np.any(np.isinf(variance)):
            raise InputError("variance is negative or infinite; it must be at least 0, or NaN where unknown")
        variance = variance.astype(np.float32)
    return Block(scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=shape), variance)
