# SPDX-License-Identifier: BSD-3-Clause
"""`BlockStore`: a transport on disk that grows by batches of columns, and is never half of one.

A growing store is a folder of `zarr.json` (sizes, provenance, attributes, checksum) and `log/`, an
.npz and its SHA-256 a batch or small array, each written in a temporary and renamed. `finalize`
lets zarr write T next to the log: rows in `channel_0/block_000000.0` and so on, in binsparse CSR
layout, small arrays in `extra/NAME.0`, each array one chunk with crc32c. With the rename of
zarr.json, which then has the SHA-256 of every file, the store is final, and the log goes. Ended at
any moment, all that was committed stays.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
import json
import os
import re
import shutil
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import (
    as_path,
    fill_folder,
    flush_tree,
    input_file,
    locked,
    replace_file,
    restore,
    sweep,
)
from ltcl.store.record import CSR, EXTRAS, Parts, Record, StoredRows, about, declared, sparse
from ltcl.transport import first_bounce
from ltcl.transport.noise import Noise

_START, _UNSEALED = b'{"attributes": {"checksum": "', b"0" * 64
_ENTRY = re.compile(r"([A-Za-z][A-Za-z0-9_.-]{0,120})\.npz")
_ARRAY = re.compile(
    r"((.+)\.\d+/(\w+))/zarr\.json"
)  # of a final store: place, name of the group, name
_BINSPARSE: dict[str, str] = dict(zip(("values", "indices_1", "pointers_to_1"), CSR, strict=True))
Block = namedtuple(
    "Block", "matrix variance"
)  # rows of T, or columns, and the variance of their entries


@dataclass
class Layout:
    """Sizes of a stored transport: `shape` (M, N), `grid` and `camera_grid` (h, w), 1 or 3 `channels`.

    A block is `block_rows` rows of T, or columns in the log; "compressed", all of T is in extra
    arrays.
    """

    shape: tuple[int, int]
    grid: Any
    camera_grid: tuple[int, int] | None = None
    channels: int = 1
    block_rows: Any = None
    kind: str = "blocks"
    dtype: str = "float32"
    schema: int = 2

    def __post_init__(self) -> None:
        M, N = self.shape = checks.grid("shape", self.shape)
        self.grid = checks.grid("grid", self.grid, N)
        if self.camera_grid is not None or M != N:
            self.camera_grid = checks.grid("camera_grid", self.camera_grid, M)
        checks.count("shape", max(M, N), most=(1 << 31) - 1)  # column indices are of 32 bits
        checks.one_of("channels", self.channels, (1, 3))
        checks.one_of("schema", self.schema, (1, 2))
        if self.block_rows is None:
            self.block_rows = max(1, min(M, (1 << 23) // N))  # 64 MiB of full rows
        checks.count("block_rows", self.block_rows, least=(max(M, N) >> 20) + 1)  # a million blocks

    def blocks(self, orientation: str = "rows") -> int:
        """Number of blocks of a channel, of "rows" or "columns"."""
        return -(-self.shape[orientation == "columns"] // self.block_rows)

    def span(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """First row (or column) of a block, and the one behind its last."""
        start = block * self.block_rows
        return start, min(start + self.block_rows, self.shape[orientation == "columns"])

    def block_shape(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """(rows, N), or (columns, M) of one that holds columns of T as rows."""
        start, stop = self.span(block, orientation)
        return stop - start, self.shape[orientation == "rows"]


@dataclass
class ArrayLog:
    """Sets of arrays by name in the folder `path`, which the first makes: an .npz and its SHA-256 each."""

    path: Path

    @property
    def names(self) -> list[str]:
        """Of what is committed, by whatever process."""
        with about(self.path):
            files = os.listdir(self.path) if self.path.exists() else []
        return sorted(entry[1] for entry in map(_ENTRY.fullmatch, files) if entry)

    def put(self, name: str, **arrays: Any) -> None:
        """Commit arrays of numbers or texts; what has that name already is replaced whole, or stays."""
        if not _ENTRY.fullmatch(f"{name}.npz"):
            raise InputError(
                f"name is {name!r:.60}; it must be letters, digits, _, - and ., a letter first"
            )
        with replace_file(self.path / f"{name}.npz") as temporary:
            np.savez(temporary, **arrays)
            raw = temporary.read_bytes()
            temporary.write_bytes(raw + hashlib.sha256(raw).hexdigest().encode())

    def get(self, name: str) -> dict[str, np.ndarray]:
        """The arrays under a name, whose checksums are compared."""
        with about(self.path, reading=True):
            raw = input_file(self.path / f"{name}.npz").read_bytes()
            if hashlib.sha256(raw[:-64]).hexdigest().encode() != raw[-64:]:
                raise FileError(f"{name}.npz is damaged: its checksum differs")
            return dict(np.load(io.BytesIO(raw), allow_pickle=False))


class BlockStore:
    """A transport that grows by batches of its columns, made by `create` or opened by `open`.

    Any number of processes may write at once; what they write is committed when the call returns.
    After `finalize` it is `final`: T is there by rows, and nothing is written any more.

    Examples
    --------
    >>> import tempfile, scipy.sparse
    >>> store = BlockStore.create(tempfile.mkdtemp(), shape=(4, 4), grid=(2, 2), block_rows=2)
    >>> store.write(0, 1, scipy.sparse.eye_array(2, 4, k=2))
    >>> sorted(store.written), store.missing()
    ([(0, 1)], [(0, 0)])
    """

    def __init__(self, path: Path) -> None:
        self.path, self._log = path, ArrayLog(path / "log")
        self._refresh()

    def __repr__(self) -> str:
        return f"BlockStore({str(self.path)!r}, shape={self.layout.shape}, final={self.final})"

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        *,
        provenance: Any = None,
        overwrite: bool = False,
        **sizes: Any,
    ) -> BlockStore:
        """An empty store at `path`, where nothing is yet, or a store to `overwrite`.

        `sizes` are those of `Layout`, with `block_rows` columns a batch; `provenance` is plain
        JSON.
        """
        from ltcl import __version__  # here, because it is set after this module is imported

        path, layout = as_path(path), Layout(**sizes)
        check_place(path, overwrite)
        with fill_folder(path, replace=True) as folder:
            _write_document(
                folder, layout, {"versions": {"ltcl": __version__}, **(provenance or {})}, {}
            )
        return cls(path)

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> BlockStore:
        """Open a store to read and to write; blocks are checked when they are read."""
        path = as_path(path)
        with about(path):
            restore(Path(os.path.realpath(path)))
            if not path.exists():
                raise FileError("no such folder")
        return cls(path)

    @property
    def written(self) -> frozenset[tuple[int, int]]:
        """(channel, batch) of all in the log; asked of the disk, so other writers' batches count."""
        return frozenset(
            (int(n[8]), int(n[10:])) for n in self._log.names if n.startswith("columns_")
        )

    def missing(self) -> list[tuple[int, int]]:
        """(channel, batch) of all that is not committed, in order."""
        every = itertools.product(range(self.layout.channels), range(self.layout.blocks("columns")))
        return [] if self.final else sorted(set(every) - self.written)

    def write(self, channel: int, block: int, matrix: Any, variance: Any = None) -> None:
        """Commit a batch: when this returns it is on the disk, whole; if it raises, what was there still is.

        `matrix` is sparse (columns, M), kept as float32; `variance` (nnz,) of entries is NaN where
        unknown.
        """
        name = self._name(channel, block)
        C, variance = _checked(matrix, variance, self.layout.block_shape(block, "columns"))
        with self._writing():
            self._log.put(name, **{array: getattr(C, array) for array in CSR}, variance=variance)

    def block(self, channel: int, block: int) -> Block:
        """Rows of T of a final store, else a batch as `write` took it; its checksums are compared."""
        name, shape = self._name(channel, block), self.layout.block_shape(block, self._orientation)
        with about(self.path, reading=True), about(name, reading=True):
            arrays = self._get(name)
            data, *places = (arrays[array] for array in CSR)
            matrix = sparse(
                lambda: scipy.sparse.csr_array((data, *places), shape=shape), shape, len(data)
            )
            return Block(matrix, arrays.get("variance"))

    def rows_again(self, channel: int, block: int) -> tuple[int, scipy.sparse.csr_array]:
        """First row and matrix of a `block` checked before, read without checks: as fast as the disk."""
        first, shape = self.layout.span(block)[0], self.layout.block_shape(block)
        places = (
            self.path / self._places[self._name(channel, block)][name] / "c/0" for name in CSR
        )
        with contextlib.suppress(
            OSError, ValueError, IndexError
        ):  # an array of no entries has no file
            bare = (np.fromfile(place, np.uint8)[:-4] for place in places)  # without crc32c
            types = self.layout.dtype, np.int32, np.int64
            data, indices, indptr = (
                array.view(type_) for array, type_ in zip(bare, types, strict=True)
            )
            if len(data) == len(indices) == indptr[-1] and len(indptr) == shape[0] + 1:
                kind = np.int32 if len(data) < 1 << 31 else np.int64  # SciPy makes both alike
                return first, scipy.sparse.csr_array(
                    (data, indices, indptr.astype(kind)), shape=shape
                )
        return first, self.block(channel, block).matrix  # in another layout, or damaged

    def extra(self, name: str, array: Any = None) -> np.ndarray:
        """A small array by name: committed where `array` is given, else read and checked."""
        if array is None:
            with about(self.path, reading=True):
                return self._get(f"extra.{name}")["array"]
        array = checks.real(name, array)
        with self._writing():
            self._log.put(f"extra.{name}", array=array)
        return array

    @property
    def extras(self) -> list[str]:
        """Names of the extra arrays."""
        return [name[6:] for name in self._places or self._log.names if name.startswith("extra.")]

    def update(self, **attributes: Any) -> None:
        """Change some of the `attributes`, at once or not at all; other processes' changes are kept."""
        with self._writing():
            _write_document(self.path, self.layout, self.provenance, self.attributes | attributes)
            self._refresh()

    def finalize(
        self,
        *,
        sigmas=0.0,
        change: Callable | None = None,
        compressed: Parts | None = None,
        memory=1 << 28,
    ) -> None:
        """Turn columns into rows, out of core; find the first bounce; close the store for good.

        The diagonal is a first bounce where it is above 0 by `sigmas` standard deviations;
        `change`, of channel, first row, rows (rows, N) and the variance of their entries, returns
        the last two anew. A transport `compressed` takes the place of all columns. `memory` is
        about how many bytes are used.
        """
        with self._writing(finished=True):
            if not self.final:
                extras = {name: self.extra(name) for name in self.extras}
                layout, state, rows = self.layout, self.attributes, self._rows(memory, change)
                if compressed is not None:
                    layout, arrays, texts = _compressed(compressed)
                    rows, extras, state = (), extras | arrays, state | texts
                elif missing := self.missing():
                    raise FileError(
                        f"lacks {len(missing)} blocks (channel, block) {missing[:6]}; resume it"
                    )
                _write_finished(self.path, layout, rows, extras, self.provenance, state, sigmas)
                self._refresh()
            shutil.rmtree(self._log.path, ignore_errors=True)

    def verify(self) -> None:
        """Read everything and compare all checksums; the first thing that is wrong is raised as FileError."""
        self._refresh()
        with about(self.path):
            for file in self._files:
                self._check(file)
            for name in () if self.final else self._log.names:
                self._log.get(name)

    def _name(self, channel: int, block: int) -> str:
        checks.count("channel", channel, least=0, most=self.layout.channels - 1)
        checks.count("block", block, least=0, most=self.layout.blocks(self._orientation) - 1)
        return (
            f"channel_{channel}/block_{block:06d}"
            if self.final
            else f"columns_{channel}.{block:06d}"
        )

    def _get(self, name: str) -> dict[str, np.ndarray]:
        if not self.final:
            return self._log.get(name)
        return {array: self._read(place) for array, place in self._places[name].items()}

    def _read(self, place: str) -> np.ndarray:
        import zarr

        with about(place, reading=True):
            self._check(f"{place}/zarr.json")
            array = zarr.open_array(self.path / place, mode="r")
            stored = self._check(f"{place}/c{'/0' * array.ndim}") if array.size else 0
            declared("it", array.dtype, array.shape, stored)
            return np.asarray(array[...]).reshape(array.shape)

    def _check(self, file: str) -> int:
        """The bytes of a file of a final store, whose checksum is compared."""
        raw = input_file(self.path / file).read_bytes()
        if hashlib.sha256(raw).hexdigest() != self._files[file]:
            raise FileError(f"{file} is damaged: its checksum is not that of its bytes")
        return len(raw)

    @contextlib.contextmanager
    def _writing(self, *, finished: bool = False) -> Iterator[None]:
        with about(self.path), locked(self.path):
            sweep(self.path.parent)
            self._refresh()
            if self.final and not finished:
                raise FileError("is final; nothing is written to it any more")
            yield

    def _refresh(self) -> None:
        with about(self.path, reading=True):
            content = _read_document(self.path / "zarr.json")
            content["ltcl"].pop("orientation", None)  # of earlier stores
            self.layout, self.provenance = Layout(**content["ltcl"]), content["provenance"]
            self.attributes: dict[str, Any] = content["state"]
            files = (
                _files_1(self.path, content) if self.layout.schema == 1 else content.get("files")
            )
            self.final, self._files = files is not None, files or {}
            self._orientation = "rows" if self.final else "columns"
            self._places: dict[str, dict[str, str]] = {}  # of arrays in their groups
            for place, group, array in (
                m.groups() for m in map(_ARRAY.fullmatch, self._files) if m
            ):
                arrays = self._places.setdefault(group.replace("extra/", "extra."), {})
                arrays[_BINSPARSE.get(array, array)] = place

    def _rows(self, memory: int, change: Callable | None) -> Iterator[tuple[int, int, Block]]:
        """All blocks of rows; as many as fit the memory are gathered in a pass over the columns."""
        layout, span, batches = self.layout, self.layout.span, range(self.layout.blocks("columns"))
        size = sum(file.stat().st_size for file in self._log.path.iterdir()) // layout.channels
        passes = min(
            4 * size // memory + 1, layout.blocks()
        )  # entries as cut, joined and transposed
        change = change or (lambda channel, first, *rows: rows)
        parts = np.array_split(np.arange(layout.blocks()), passes)
        for channel, blocks in itertools.product(range(layout.channels), parts):
            first, stop, columns = span(blocks[0])[0], span(blocks[-1])[1], []
            for C, variance in (self.block(channel, batch) for batch in batches):
                data = np.stack([C.data, variance], axis=1).view(np.complex64).ravel()  # T + i V
                columns.append(
                    scipy.sparse.csr_array((data, C.indices, C.indptr), C.shape)[:, first:stop]
                )
            T = scipy.sparse.vstack(columns, "csr").T.tocsr()
            for block in blocks.tolist():
                R = T[span(block)[0] - first : span(block)[1] - first]
                rows, variance = change(channel, span(block)[0], R.real, R.data.imag.copy())
                yield channel, block, _checked(rows, variance, layout.block_shape(block))


def read(path: Path) -> Record | Parts:
    """The transport in a store, none of it in memory yet; each block is checked once, here."""
    store = BlockStore.open(path)
    if not store.final:
        raise FileError("is a scan that is not finished; finalize it first")
    if store.layout.kind == "compressed":
        arrays = {
            name: store.extra(name) for name in store.attributes["arrays"]
        }  # others are no part of it
        return Parts(
            arrays | {name: np.array(str(text)) for name, text in store.attributes["texts"].items()}
        )
    matrices = tuple(StoredRows(store, channel) for channel in range(store.layout.channels))
    extras = {n: store.extra(n) for n in store.extras if n in EXTRAS or n.startswith("noise_")}
    F, grids = extras.get("first_bounce"), (store.layout.grid, store.layout.camera_grid)
    F = F[0] if F is not None and len(F) == 1 else F
    return Record(matrices, *grids, F, extras.get("mixing"), Noise.from_arrays(extras))


def write(path: Path, content: Record | Parts) -> None:
    """Write a store in a temporary folder and put it at `path` when it is whole; float64 stays float64."""
    check_place(path, overwrite=True)
    rows, state = (), {}
    if isinstance(content, Parts):
        layout, extras, state = _compressed(content)
    else:
        T: Any = content.matrices
        dtype = np.result_type(*(M.dtype for M in T), np.float32).name
        layout = Layout(content.shape, content.grid, content.camera_grid, len(T), dtype=dtype)
        extras = {
            n: np.atleast_2d(a)
            for n, a in vars(content).items()
            if n in EXTRAS[2:] and a is not None
        }
        extras |= {} if content.noise is None else content.noise.to_arrays()
        every = itertools.product(range(len(T)), range(layout.blocks()))
        rows = (
            (c, k, Block(scipy.sparse.csr_array(T[c][slice(*layout.span(k))]), None))
            for c, k in every
        )
    with fill_folder(path, replace=True) as folder:
        _write_finished(folder, layout, rows, extras, {}, state)


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse at once, before there is anything to keep, a place where no store can be made."""
    with about(path):
        target = Path(os.path.realpath(path))
        restore(target)
        if target.exists() and (not target.is_dir() or any(target.iterdir())):
            document = target / "zarr.json"
            is_store = document.is_file() and document.read_bytes().startswith(_START)
            if not (is_store and overwrite):
                raise FileError(
                    f"exists; {'give overwrite=True' if is_store else 'it is no store of ltcl'}"
                )


def _compressed(parts: Parts) -> tuple[Layout, dict[str, Any], dict[str, Any]]:
    """Layout, arrays and attributes of their store."""
    texts = {name: str(array) for name, array in parts.arrays.items() if array.dtype.kind in "SU"}
    arrays = {name: parts.arrays[name] for name in sorted(parts.arrays.keys() - texts.keys())}
    layout = Layout(parts.shape, parts.grid, channels=len(parts.first_bounce), kind="compressed")
    return layout, arrays, {"texts": texts, "arrays": list(arrays)}


def _checked(matrix: Any, variance: Any, shape: tuple[int, int]) -> Block:
    """What is to be written, as float32; refused before anything is."""
    matrix = checks.csr("matrix", matrix)
    checks.shape("matrix", matrix, shape)
    with np.errstate(over="ignore"):
        values = checks.finite("matrix as float32", matrix.data.astype(np.float32))
    variance = (
        np.full(matrix.nnz, np.nan) if variance is None else checks.real("variance", variance)
    )
    checks.shape("variance", variance, (matrix.nnz,))
    if np.any(variance < 0) or np.any(np.isinf(variance)):
        raise InputError(
            "variance is negative or infinite; it must be at least 0, or NaN where unknown"
        )
    rows = scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=shape)
    return Block(rows, variance.astype(np.float32))


def _write_finished(
    root: Path,
    layout: Layout,
    rows: Any,
    extras: Any,
    provenance: Any,
    state: Any,
    sigmas: float = 0.0,
) -> None:
    """Write T and all small arrays by zarr into `root`, flushed, and last the document with their SHA-256."""
    groups = ["extra", *(f"channel_{c}" for c in range(layout.channels))]
    for group in groups:
        shutil.rmtree(root / group, ignore_errors=True)  # of a process that ended here
        _write_group(root / group, {})
    F = np.zeros((layout.channels, layout.shape[1]))
    is_square = layout.camera_grid in (None, layout.grid)  # only then T has a first bounce
    types = {"values": layout.dtype, "indices_1": "int32", "pointers_to_1": "int64"}
    for channel, number, (T, variance) in rows:
        arrays = {
            name: np.asarray(getattr(T, _BINSPARSE[name]), dtype) for name, dtype in types.items()
        }
        arrays |= {} if variance is None else {"variance": variance}
        header = {"version": "0.1", "format": "CSR", "shape": T.shape, "data_types": types}
        header["number_of_stored_values"] = T.nnz
        _write_group(root / f"channel_{channel}/block_{number:06d}.0", arrays, binsparse=header)
        if is_square:
            start, stop = layout.span(number)
            V = variance if sigmas > 0 and variance is not None else np.zeros(T.nnz)
            V = scipy.sparse.csr_array((V, T.indices, T.indptr), shape=T.shape).diagonal(start)
            F[channel, start:stop] = first_bounce.drop_uncertain(T.diagonal(start), V, sigmas)
    if layout.kind == "blocks" and is_square:
        extras = {"first_bounce": F, **extras}
    for name, array in extras.items():
        _write_group(root / "extra" / f"{name}.0", {"array": np.asarray(array)})
    files = [file for group in groups for file in flush_tree(root / group)]
    sums = {
        f.relative_to(root).as_posix(): hashlib.sha256(f.read_bytes()).hexdigest() for f in files
    }
    _write_document(root, layout, provenance, state, files=sums)


def _write_group(folder: Path, arrays: Mapping[str, np.ndarray], **attributes: Any) -> None:
    import zarr.codecs

    group = zarr.create_group(folder, attributes=attributes)
    options: Any = {
        "compressors": zarr.codecs.Crc32cCodec(),
        "config": {"write_empty_chunks": True},
    }
    for name, array in arrays.items():
        chunks = tuple(max(n, 1) for n in array.shape)
        group.create_array(name, data=array, chunks=chunks, **options)


def _write_document(root: Path, layout: Layout, provenance: Any, state: Any, **files: Any) -> None:
    """Seal and write the zarr.json: its checksum is that of the same bytes with zeros in its place."""
    content = {"ltcl": asdict(layout), "provenance": provenance, "state": state, **files}
    group = {"attributes": {"checksum": _UNSEALED.decode(), **content}, "zarr_format": 3}
    try:
        raw = json.dumps(group | {"node_type": "group"}, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise InputError(f"attributes are not plain JSON: {str(error)!a:.150}") from None
    with replace_file(root / "zarr.json") as temporary:
        temporary.write_bytes(raw.replace(_UNSEALED, hashlib.sha256(raw).hexdigest().encode(), 1))


def _read_document(file: Path) -> dict[str, Any]:
    """The attributes in a zarr.json; refused if a byte of it has changed."""
    raw, stop = input_file(file).read_bytes(), len(_START) + len(_UNSEALED)
    checksum = hashlib.sha256(_START + _UNSEALED + raw[stop:]).hexdigest().encode()
    if not raw.startswith(_START + checksum):
        raise FileError(f"{file.name} is damaged, or not written by ltcl: its checksum differs")
    return json.loads(raw)["attributes"]


def _files_1(root: Path, content: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the arrays of a final store of schema 1, which the zarr.json of each group has."""
    if not content.get("final"):
        raise FileError("was begun by an earlier ltcl; finish it with that version")
    files = {}
    for group in content["final"]:
        for name, entry in _read_document(root / group / "zarr.json")["arrays"].items():
            files[f"{group}/{name}/zarr.json"] = entry["metadata"]
            if "sha256" in entry:  # none of an empty array
                files[f"{group}/{name}/c{'/0' * len(entry['shape'])}"] = entry["sha256"]
    return files
