# SPDX-License-Identifier: BSD-3-Clause
"""`BlockStore`: a transport on disk that grows by batches of columns, and is never half of one.

A growing store is a folder of `zarr.json` (sizes, provenance, attributes, checksum) and `log/`, an
`ArrayLog` with an entry for each batch and small array. `finalize` turns the columns into rows,
which zarr writes next to the log; with the rename of zarr.json, which then has the SHA-256 of every
file, the store is final, and the log goes. Whenever a process ends, all that was committed stays.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import re
import shutil
from collections import ChainMap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError
from ltcl.files import (
    PinnedFolder,
    as_path,
    fill_folder,
    input_file,
    locked,
    sweep,
)
from ltcl.store.array_log import ArrayLog
from ltcl.store.document import DOCUMENT, StoreLayout, is_store, read_document, write_document
from ltcl.store.final_store import (
    BINSPARSE,
    Block,
    FinalContent,
    PlacedBlock,
    check_block,
    write_final,
)
from ltcl.store.guards import about, check_declared, sparse_floats
from ltcl.store.record import CSR, EXTRAS, CompressedRecord, StoredRows, StoreRecord
from ltcl.transport.noise import Noise

# A file of a final store: place of the array, its group, its name.
ARRAY_FILE = re.compile(r"((.+)\.\d+/(\w+))/zarr\.json")
CRC32C_BYTES = 4
# File of a folder in which `ltcl acquire` works.
ACQUISITION = "acquisition.toml"
EXTRA = "extra."
COLUMNS = re.compile(r"columns_(\d)\.(\d+)")

# Rows of a block of a sparse T, whose rows have few entries.
SPARSE_BLOCK_ROWS = 1 << 16

# Of channel, first row, rows (rows, N) and variance of their entries; returns the last two changed.
RowChange = Callable[[int, int, scipy.sparse.csr_array, np.ndarray], tuple[Any, Any]]


class SparseMatrix(NamedTuple):
    """T of one channel, its indices sorted, and the variance of its entries, (nnz,)."""

    matrix: scipy.sparse.csr_array
    variance: np.ndarray


class BlockStore:
    """A transport that grows by batches of its columns, made by `create` or opened by `open`.

    Any number of processes may write at once; what they write is committed when the call returns.
    After `finalize` it is `final`: T is there by rows, and nothing is written any more.

    Attributes
    ----------
    layout : StoreLayout
    provenance, attributes : dict
        Plain JSON: where the transport comes from; what `update` keeps. They are
        from the last time that this object read or wrote the store; `update` adds to what others
        have written since.
    final : bool

    Examples
    --------
    >>> import tempfile, scipy.sparse
    >>> store = BlockStore.create(tempfile.mkdtemp(), shape=(4, 4), grid=(2, 2), block_rows=2)
    >>> store.write(0, 1, scipy.sparse.eye_array(2, 4, k=2))
    >>> sorted(store.written), store.missing()
    ([(0, 1)], [(0, 0)])
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._log = ArrayLog(path / "log")
        # What a final store is read from: it stays, though another one takes its place.
        self._folder: PinnedFolder | None = None
        self._open()

    def __repr__(self) -> str:
        return f"BlockStore({str(self.path)!r}, shape={self.layout.shape}, final={self.final})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopen, (self.path, self._files)

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        provenance: Any = None,
        overwrite: bool = False,
        **sizes: Any,
    ) -> BlockStore:
        """Make an empty store at `path`, where nothing is yet, or a store to `overwrite`.

        `sizes` are those of `StoreLayout`, with `block_rows` columns a batch; `provenance` is plain
        JSON.
        """
        from ltcl import __version__  # set after this module is imported

        path = as_path(path)
        layout = StoreLayout(**sizes)
        check_place(path, overwrite)
        origin = {"versions": {"ltcl": __version__}}
        if provenance:
            origin |= provenance
        with fill_folder(path, replace=True) as folder:
            write_document(folder, layout, origin, {})
        return cls(path)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> BlockStore:
        """Open a store to read and to write; blocks are checked when they are read."""
        path = as_path(path)
        return cls(path)

    @classmethod
    def of(cls, store: BlockStore | str | os.PathLike[str]) -> BlockStore:
        """A store, or the one at a path."""
        if isinstance(store, BlockStore):
            return store
        return cls.open(store)

    @property
    def written(self) -> frozenset[tuple[int, int]]:
        """Set of (channel, batch) in the log on the disk, so other writers' batches count."""
        matches = map(COLUMNS.fullmatch, self._log.names)
        return frozenset((int(match[1]), int(match[2])) for match in matches if match)

    def missing(self) -> list[tuple[int, int]]:
        """(channel, batch) of all that is not committed, in order."""
        if self.final:
            return []
        channels = range(self.layout.channels)
        batches = range(self.layout.blocks("columns"))
        return sorted(set(itertools.product(channels, batches)) - self.written)

    def write(self, channel: int, block: int, matrix: Any, variance: Any = None) -> None:
        """Commit a batch: when this returns it is on the disk; if it raises, nothing has changed.

        `matrix` is sparse (columns, M), kept as float32; `variance` (nnz,) of entries is NaN where
        unknown.
        """
        name = self._name(channel, block)
        shape = self.layout.block_shape(block, "columns")
        columns = check_block(matrix, variance, shape)
        arrays = {array: getattr(columns.matrix, array) for array in CSR}
        with self._writing():
            self._log.put(name, **arrays, variance=columns.variance)

    def block(self, channel: int, block: int) -> Block:
        """Rows of T of a final store, else a batch as `write` took it; checksums are compared."""
        name = self._name(channel, block)
        shape = self.layout.block_shape(block, self._orientation)
        with about(self.path, reading=True), about(name, reading=True):
            arrays = self._get(name)
            csr = tuple(arrays[array] for array in CSR)
            entries = len(arrays["data"])
            matrix = sparse_floats(lambda: scipy.sparse.csr_array(csr, shape=shape), shape, entries)
            return Block(matrix, arrays.get("variance"))

    def rows_again(self, channel: int, block: int) -> tuple[int, scipy.sparse.csr_array]:
        """First row and matrix of a `block` checked before, read without checks, at disk speed."""
        first, _ = self.layout.span(block)
        matrix = self._read_bare(channel, block)
        if matrix is None:  # in another layout, or damaged
            matrix = self.block(channel, block).matrix
        return first, matrix

    def _read_bare(self, channel: int, block: int) -> scipy.sparse.csr_array | None:
        """Rows as the files hold them, None where these are not as `write_final` writes them."""
        shape = self.layout.block_shape(block)
        places = self._places[self._name(channel, block)]
        types = {"data": self.layout.dtype, "indices": np.int32, "indptr": np.int64}
        arrays = {}
        # An array of no entries has no file.
        with contextlib.suppress(OSError, ValueError, IndexError):
            for name, dtype in types.items():
                stored = np.fromfile(self._root / places[name] / "c/0", np.uint8)
                arrays[name] = stored[:-CRC32C_BYTES].view(dtype)
            entries = len(arrays["data"])
            pointers = arrays["indptr"]
            if entries != len(arrays["indices"]) or entries != pointers[-1]:
                return None
            if len(pointers) != shape[0] + 1:
                return None
            # SciPy needs both of one type, and would convert the longer array.
            pointer_type = np.int32 if entries < 1 << 31 else np.int64
            csr = (arrays["data"], arrays["indices"], pointers.astype(pointer_type))
            return scipy.sparse.csr_array(csr, shape=shape)
        return None

    def extra(self, name: str, array: Any = None) -> np.ndarray:
        """A small array by name: committed where `array` is given, else read and checked."""
        if array is None:
            with about(self.path, reading=True):
                return self._get(f"{EXTRA}{name}")["array"]
        array = checks.real(name, array)
        with self._writing():
            self._log.put(f"{EXTRA}{name}", array=array)
        return array

    @property
    def extras(self) -> list[str]:
        """Names of the extra arrays."""
        names = self._places if self.final else self._log.names
        return [name.removeprefix(EXTRA) for name in names if name.startswith(EXTRA)]

    def update(self, **attributes: Any) -> None:
        """Change some of the `attributes`, at once or not at all; keep other processes' changes."""
        with self._writing():
            changed = self.attributes | attributes
            write_document(self.path, self.layout, self.provenance, changed)
            self._read_document()

    def finalize(
        self,
        *,
        sigmas: float = 0.0,
        change: RowChange | None = None,
        compressed: CompressedRecord | None = None,
        matrices: Sequence[SparseMatrix] | None = None,
        memory: int = 1 << 28,
    ) -> None:
        """Turn columns into rows, out of core; find the first bounce; close the store for good.

        The diagonal is a first bounce where it is above 0 by `sigmas` standard deviations. `change`
        of channel, first row, rows (rows, N) and the variance of their entries returns the last two
        changed. A transport `compressed` takes the place of all columns, or `matrices` do, T (M, M)
        of each channel with M pixels of the camera. `memory` is about how many bytes are used.
        """
        with self._writing(finished=True):
            if not self.final:
                if matrices is not None:
                    self._finish_matrices(sigmas, matrices)
                else:
                    self._finish(sigmas, change, compressed, memory)
        self._open()
        shutil.rmtree(self._root / "log", ignore_errors=True)

    def _finish(
        self,
        sigmas: float,
        change: RowChange | None,
        compressed: CompressedRecord | None,
        memory: int,
    ) -> None:
        """Write the files of the final store."""
        extras = _StoredExtras(self)
        layout = self.layout
        if compressed is not None:
            layout, content = compressed_content(compressed)
            state = {**self.attributes, **content.state}
            content = FinalContent(extras=ChainMap(dict(content.extras), extras), state=state)
        else:
            missing = self.missing()
            if missing:
                raise FileError(
                    f"lacks {len(missing)} blocks (channel, block) {missing[:6]}; resume it"
                )
            content = FinalContent(
                rows=self._rows(memory, change),
                extras=extras,
                state=self.attributes,
                sigmas=sigmas,
            )
        write_final(self.path, layout, self.provenance, content)

    def _finish_matrices(self, sigmas: float, matrices: Sequence[SparseMatrix]) -> None:
        """Write the files of the final store of a sparse T."""
        pixels = self.layout.shape[0]
        layout = StoreLayout(
            (pixels, pixels),
            self.layout.camera_grid or self.layout.grid,
            channels=len(matrices),
            block_rows=min(pixels, SPARSE_BLOCK_ROWS),
        )
        content = FinalContent(
            rows=_blocks_of_matrices(layout, matrices),
            extras=_StoredExtras(self),
            state=self.attributes,
            sigmas=sigmas,
        )
        write_final(self.path, layout, self.provenance, content)

    def verify(self) -> None:
        """Read everything and compare all checksums; FileError names the first that differs."""
        self._open()
        with about(self.path):
            for file in self._files:
                self._check(file)
            if not self.final:
                for name in self._log.names:
                    self._log.get(name)

    def _name(self, channel: int, block: int) -> str:
        blocks = self.layout.blocks(self._orientation)
        checks.count("channel", channel, least=0, most=self.layout.channels - 1)
        checks.count("block", block, least=0, most=blocks - 1)
        if self.final:
            return f"channel_{channel}/block_{block:06d}"
        return f"columns_{channel}.{block:06d}"

    def _get(self, name: str) -> dict[str, np.ndarray]:
        if not self.final:
            return self._log.get(name)
        return {array: self._read(place) for array, place in self._places[name].items()}

    def _read(self, place: str) -> np.ndarray:
        """An array of a final store, whose checksums are compared."""
        import zarr

        with about(place, reading=True):
            self._check(f"{place}/zarr.json")
            array = zarr.open_array(self._root / place, mode="r")
            stored = 0
            if array.size:
                stored = self._check(f"{place}/c{'/0' * array.ndim}")
            check_declared("it", array.dtype, array.shape, stored)
            return np.asarray(array[...]).reshape(array.shape)

    def _check(self, file: str) -> int:
        """Compare the checksum of a file of a final store; its bytes."""
        raw = input_file(self._root / file, shown=Path(file)).read_bytes()
        if hashlib.sha256(raw).hexdigest() != self._files[file]:
            raise FileError(f"{file} is damaged: its checksum is not that of its bytes")
        return len(raw)

    @contextlib.contextmanager
    def _writing(self, *, finished: bool = False) -> Iterator[None]:
        with about(self.path), locked(self.path):
            sweep(self.path.parent)
            self._read_document()
            if self.final and not finished:
                raise FileError("is final; nothing is written to it any more")
            yield

    @property
    def _root(self) -> Path:
        """Folder where the files are read."""
        if self._folder is None:
            return self.path
        return self._folder.root

    def _open(self) -> None:
        """Read the document again, and pin the folder of a final store."""
        with about(self.path, reading=True):
            self._folder = pinned(self.path)
        self._read_document()
        if not self.final:
            # Its files change their places while it grows.
            self._folder = None

    def _read_document(self) -> None:
        """Read the document, which other processes may have changed."""
        with about(self.path, reading=True):
            content = read_document(self._root / DOCUMENT)
            self.layout = StoreLayout(**content["ltcl"])
            self.provenance = content["provenance"]
            self.attributes: dict[str, Any] = content["state"]
            self.final = "files" in content
            self._files: dict[str, str] = content.get("files", {})
            self._orientation = "rows" if self.final else "columns"
            self._places = places_of_arrays(self._files)

    def _rows(self, memory: int, change: RowChange | None) -> Iterator[PlacedBlock]:
        """All blocks of rows; as many as fit the memory are gathered in a pass over the columns."""
        layout = self.layout
        log_bytes = sum(file.stat().st_size for file in self._log.path.iterdir())
        channel_bytes = log_bytes // layout.channels
        # Entries lie in memory four times: as they are read, cut, joined and transposed.
        passes = min(4 * channel_bytes // memory + 1, layout.blocks())
        groups = np.array_split(np.arange(layout.blocks()), passes)
        for channel, group in itertools.product(range(layout.channels), groups):
            numbers = group.tolist()
            first, _ = layout.span(numbers[0])
            _, stop = layout.span(numbers[-1])
            T, V = self._gather(channel, first, stop)
            for number in numbers:
                start, end = layout.span(number)
                rows = T[start - first : end - first]
                variance = V[start - first : end - first].data
                if change is not None:
                    rows, variance = change(channel, start, rows, variance)
                block = check_block(rows, variance, layout.block_shape(number))
                yield PlacedBlock(channel, number, block)

    def _gather(
        self, channel: int, first: int, stop: int
    ) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """Rows first .. stop - 1 of T and of the variances, which have the same pattern."""
        values = []
        variances = []
        for batch in range(self.layout.blocks("columns")):
            columns, variance = self.block(channel, batch)
            pattern = (variance, columns.indices, columns.indptr)
            variance_columns = scipy.sparse.csr_array(pattern, shape=columns.shape)
            values.append(columns[:, first:stop])
            variances.append(variance_columns[:, first:stop])
        T = scipy.sparse.vstack(values, "csr").T.tocsr()
        V = scipy.sparse.vstack(variances, "csr").T.tocsr()
        return scipy.sparse.csr_array(T), scipy.sparse.csr_array(V)


def _reopen(path: Path, files: dict[str, str]) -> BlockStore:
    """Open a store in another process; FileError if it is not the same any more."""
    store = BlockStore.open(path)
    if store._files != files:
        raise FileError(f"{path}: was replaced since it was opened; load it again")
    return store


def places_of_arrays(files: Any) -> dict[str, dict[str, str]]:
    """Folders of the arrays of a final store, by group and name."""
    places: dict[str, dict[str, str]] = {}
    for file in files:
        match = ARRAY_FILE.fullmatch(file)
        if match is None:
            continue
        place, group, array = match.groups()
        arrays = places.setdefault(group.replace("extra/", EXTRA), {})
        arrays[BINSPARSE.get(array, array)] = place
    return places


class _StoredExtras(dict[str, Any]):
    """The extra arrays of a store, which are read one by one."""

    def __init__(self, store: BlockStore) -> None:
        super().__init__(dict.fromkeys(store.extras))
        self._store = store

    def __getitem__(self, name: str) -> np.ndarray:
        return self._store.extra(name)


def read(path: Path) -> StoreRecord | CompressedRecord:
    """Transport in a store, its matrices still on the disk; each block is checked once, here."""
    store = BlockStore.open(path)
    if not store.final:
        raise FileError("is a scan that is not finished; finalize it first")
    layout = store.layout
    if layout.kind == "compressed":
        # A scan may have left other arrays, which are no part of the transport.
        arrays = {name: store.extra(name) for name in store.attributes["arrays"]}
        for name, text in store.attributes["texts"].items():
            arrays[name] = np.array(str(text))
        return CompressedRecord(arrays)

    extras = {}
    for name in store.extras:
        if name in EXTRAS or name.startswith("noise_"):
            extras[name] = store.extra(name)
    F = extras.get("first_bounce")
    if F is not None and len(F) == 1:
        F = F[0]
    matrices = [StoredRows(store, channel) for channel in range(layout.channels)]
    return StoreRecord(
        matrices=tuple(matrices),
        grid=layout.grid,
        camera_grid=layout.camera_grid,
        first_bounce=F,
        mixing=extras.get("mixing"),
        noise=Noise.from_arrays(extras),
    )


def write(path: Path, record: StoreRecord | CompressedRecord) -> None:
    """Write a store in a temporary folder and put it at `path` when it is whole.

    Entries of float64 stay float64.
    """
    check_place(path, overwrite=True)
    if isinstance(record, CompressedRecord):
        layout, content = compressed_content(record)
    else:
        layout, content = _record_content(record)
    with fill_folder(path, replace=True) as folder:
        write_final(folder, layout, {}, content)


def _record_content(record: StoreRecord) -> tuple[StoreLayout, FinalContent]:
    """Layout and content of the store of matrices."""
    matrices: Any = record.matrices
    types = [matrix.dtype for matrix in matrices]
    layout = StoreLayout(
        record.shape,
        record.grid,
        record.camera_grid,
        channels=len(matrices),
        dtype=np.result_type(*types, np.float32).name,
    )
    extras = {}
    if record.first_bounce is not None:
        extras["first_bounce"] = np.atleast_2d(record.first_bounce)
    if record.mixing is not None:
        extras["mixing"] = np.atleast_2d(record.mixing)
    if record.noise is not None:
        extras |= record.noise.to_arrays()

    def rows() -> Iterator[PlacedBlock]:
        for channel, matrix in enumerate(matrices):
            for number in range(layout.blocks()):
                start, stop = layout.span(number)
                block = Block(scipy.sparse.csr_array(matrix[start:stop]), None)
                yield PlacedBlock(channel, number, block)

    return layout, FinalContent(rows=rows(), extras=extras, state={})


def _blocks_of_matrices(
    layout: StoreLayout, matrices: Sequence[SparseMatrix]
) -> Iterator[PlacedBlock]:
    """The blocks of rows of a sparse T."""
    for channel, (matrix, variance) in enumerate(matrices):
        for number in range(layout.blocks()):
            start, stop = layout.span(number)
            first, last = matrix.indptr[[start, stop]]
            rows = scipy.sparse.csr_array(matrix[start:stop])
            block = check_block(rows, variance[first:last], layout.block_shape(number))
            yield PlacedBlock(channel, number, block)


def compressed_content(record: CompressedRecord) -> tuple[StoreLayout, FinalContent]:
    """Layout and content of the store of a compressed transport."""
    texts = {}
    arrays = {}
    for name in sorted(record.arrays):
        array = record.arrays[name]
        if array.dtype.kind in "SU":
            texts[name] = str(array)
        else:
            arrays[name] = array
    channels = len(record.first_bounce)
    layout = StoreLayout(record.shape, record.grid, channels=channels, kind="compressed")
    state = {"texts": texts, "arrays": list(arrays)}
    return layout, FinalContent(extras=arrays, state=state)


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse at once, before there is anything to keep, a place where no store can be made."""
    with about(path):
        if _is_store_at(path):
            if not overwrite:
                raise FileError("exists; give overwrite=True")
        elif not _is_vacant(path):
            raise FileError("exists; it is no store of ltcl")


def pinned(path: Path) -> PinnedFolder:
    """The folder of a store, which stays whole while it is read; FileError if there is none."""
    try:
        return PinnedFolder(path, DOCUMENT)
    except FileNotFoundError:
        if path.is_dir():
            raise FileError(_why_no_store(path)) from None
        raise FileError("no such folder") from None
    except NotADirectoryError:
        raise FileError("is a file; a store is a folder") from None


def _why_no_store(folder: Path) -> str:
    """Tell why a folder is no store, and of an acquisition which stores are in it."""
    if not (folder / ACQUISITION).exists():
        return f"is a folder without {DOCUMENT} (of a store) or {ACQUISITION}"
    names = sorted(path.name for path in folder.glob("*.zarr") if is_store(path))
    if not names:
        return "is the folder of an acquisition without a store yet; 'ltcl acquire run' makes it"
    if len(names) == 1:
        return f"is the folder of an acquisition; give {names[0]} in it"
    return (
        f"is the folder of an acquisition with {', '.join(names)}; give one of them, or what "
        "'ltcl combine' makes of several projectors"
    )


def _is_store_at(path: Path) -> bool:
    """True if a store is at `path`, even while other processes replace it."""
    try:
        folder = pinned(path)
    except FileError:
        return False
    return is_store(folder.root)


def _is_vacant(path: Path) -> bool:
    """True if nothing is at `path`, or a folder in which nothing is."""
    if path.is_dir():
        return not any(path.iterdir())
    return not path.exists()
