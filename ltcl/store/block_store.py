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
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import scipy.sparse

from ltcl import checks, first_bounce
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.files import as_path, fill_folder, flush_tree, replace_file, restore, sweep
from ltcl.store import zarr_arrays
from ltcl.store.array_log import ArrayLog, check_name, locked
from ltcl.store.headers import about
from ltcl.store.zarr_arrays import Block

SCHEMA = 2
ORIENTATIONS = ("rows", "columns")
_FILL = 1 << 26  # bytes of a block of rows, were they full
_LARGEST = (1 << 31) - 1  # column indices are of 32 bits
_MOST_BLOCKS = 1 << 20
_PER_ENTRY = 64  # bytes: places, values and variance, as cut, joined and turned


@dataclass(frozen=True)
class Layout:
    """Sizes of a stored transport; refused where they do not fit each other.

    `shape` (M, N); `grid` and `camera_grid` (h, w), None for a camera on the projector's grid; 1 or 3
    `channels`; a block is `block_rows` rows of T, or as many columns in the log. Of the kind "compressed" all
    of T is in extra arrays, as `ltcl.transport` names them. `dtype` is that of the values.
    """

    shape: tuple[int, int]
    grid: tuple[int, int]
    camera_grid: tuple[int, int] | None = None
    channels: int = 1
    block_rows: int = 1
    orientation: str = "columns"
    kind: str = "blocks"
    dtype: str = "float32"

    def __post_init__(self) -> None:
        checks.grid("shape", self.shape)
        checks.grid("grid", self.grid, self.shape[1])
        if self.camera_grid is not None or self.shape[0] != self.shape[1]:
            checks.grid("camera_grid", self.camera_grid, self.shape[0])
        if max(self.shape) > _LARGEST:
            raise InputError(f"shape is {self.shape}; a store holds at most {_LARGEST} rows and columns")
        checks.one_of("channels", self.channels, (1, 3))
        checks.one_of("orientation", self.orientation, ORIENTATIONS)
        checks.one_of("kind", self.kind, ("blocks", "compressed"))
        checks.one_of("dtype", self.dtype, ("float32", "float64"))
        checks.count("block_rows", self.block_rows, least=-(-max(self.shape) // _MOST_BLOCKS))

    @property
    def is_square(self) -> bool:
        """Whether camera and projector have the same pixels, so that T has a first bounce."""
        return self.camera_grid in (None, self.grid)

    def blocks(self, orientation: str = "rows") -> int:
        """Number of blocks of a channel."""
        return -(-self.shape[ORIENTATIONS.index(orientation)] // self.block_rows)

    def span(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """First row (or column) of a block, and the one behind its last."""
        length = self.shape[ORIENTATIONS.index(orientation)]
        return block * self.block_rows, min((block + 1) * self.block_rows, length)

    def block_shape(self, block: int, orientation: str = "rows") -> tuple[int, int]:
        """(rows, N), or (columns, M) of one that holds columns of T as rows."""
        start, stop = self.span(block, orientation)
        return stop - start, self.shape[1 - ORIENTATIONS.index(orientation)]

    @classmethod
    def from_json(cls, sizes: Any) -> Layout:
        """Refuses another schema, and whatever makes no sense."""
        if not isinstance(sizes, Mapping) or "schema" not in sizes:
            raise FileError("zarr.json describes no store of ltcl")
        if sizes["schema"] not in (1, SCHEMA):
            raise FileError(f"zarr.json is of schema {sizes['schema']!r:.40}; this ltcl reads 1 and {SCHEMA}")
        fields: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items() if k != "schema"
        }
        try:
            return cls(**fields)
        except TypeError as error:
            raise FileError(f"zarr.json describes a store that makes no sense: {str(error)!a:.100}") from None


class BlockStore:
    """A transport that grows by batches of its columns, made by `create` or opened by `open`.

    Any number of processes may write at once; what they write is committed when the call returns.

    Attributes
    ----------
    path : Path
    layout : Layout
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
        self._log = ArrayLog(path / "log")
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
        orientation: str = "columns",
        provenance: Mapping[str, Any] | None = None,
        overwrite: bool = False,
    ) -> BlockStore:
        """An empty store at `path`, where nothing is yet, or a store to `overwrite`.

        Parameters
        ----------
        path, shape, grid, camera_grid, channels
            As in `Layout`.
        block_rows : int, optional
            Columns of a batch, and rows of a block of the finished T; about 64 MiB of full ones if not given.
        orientation : "columns"
            How T arrives.
        provenance : dict
            Plain JSON: rig, settings, hashes; the versions of ltcl, NumPy and SciPy join it.
        """
        path = as_path(path)
        shape, grid = checks.grid("shape", shape), checks.grid("grid", grid)
        camera_grid = None if camera_grid is None else checks.grid("camera_grid", camera_grid)
        checks.one_of("orientation", orientation, ("columns",))
        rows = rows_at_once(shape) if block_rows is None else block_rows
        raw = document(Layout(shape, grid, camera_grid, channels, rows), provenance or {}, {}, None)
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
            for name, checksum in (store._files or {}).items():
                if name.count("/") == 1:  # of a group: blocks and arrays are checked when they are read
                    zarr_arrays.read_file(path, name, checksum=checksum)
            if mode == "a":
                for folder in (path.parent, path, store._log.path):
                    sweep(folder)
                store._clear()
        return store

    @property
    def final(self) -> bool:
        """Whether `finalize` has ended: all of T is there by rows, and nothing will be written any more."""
        return self._files is not None

    @property
    def written(self) -> frozenset[tuple[int, int]]:
        """(channel, block) of all that is committed; asked of the disk, so other writers' blocks count."""
        pattern, names = r"columns_(\d)\.(\d+)", self._log.names
        if self.final:
            pattern, names = r"channel_(\d)/block_(\d+)", list(self._places)
        return frozenset((int(m[1]), int(m[2])) for m in (re.fullmatch(pattern, n) for n in names) if m)

    def missing(self, orientation: str | None = None) -> list[tuple[int, int]]:
        """(channel, block) of all that is not committed, in order."""
        if self.layout.kind != "blocks":
            return []
        there, blocks = self.written, self.layout.blocks(orientation or self._orientation)
        every = ((c, b) for c in range(self.layout.channels) for b in range(blocks))
        return [which for which in every if which not in there]

    def write(self, channel: int, block: int, matrix: Any, variance: Any = None) -> None:
        """Commit a batch: when this returns it is on the disk, whole; if it raises, what was there still is.

        Parameters
        ----------
        channel, block : int
            One that is there already is replaced.
        matrix : scipy.sparse, (columns, M)
            Each row of it a column of T. Kept as float32.
        variance : sparse of the same pattern, or (nnz,), optional
            Of each stored entry; NaN where unknown.
        """
        name = self._name(channel, block)
        matrix, variance = _checked(matrix, variance, self.layout.block_shape(block, "columns"))
        arrays = {"data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr}
        with self._writing():
            self._log.put(name, **arrays, **({} if variance is None else {"variance": variance}))

    def read(self, channel: int, block: int) -> scipy.sparse.csr_array:
        """Rows of T of a final store, else a batch as `write` took it; its checksums are compared."""
        return self.block(channel, block).matrix

    def variance(self, channel: int, block: int) -> np.ndarray | None:
        """Variance (nnz,) of the entries of a block; None where none was written."""
        return self.block(channel, block).variance

    def block(self, channel: int, block: int, orientation: str | None = None) -> Block:
        """Both at once; refused where the store does not hold T by the `orientation` that is asked for."""
        name = self._name(channel, block)
        with about(self.path):
            if orientation not in (None, self._orientation):
                raise FileError(f"holds {self._orientation} of T, not {orientation}")
            shape = self.layout.block_shape(block, self._orientation)
            if self._files is not None:
                place = self._place(f"channel_{channel}/block_{block:06d}")
                return zarr_arrays.read_rows(self.path, place, shape, self.layout.dtype, self._files)
            arrays = self._log.get(name)
            if not {"data", "indices", "indptr"} <= arrays.keys():
                raise FileError(f"log/{name}.npz holds no block")
            parts = (arrays["data"], arrays["indices"], arrays["indptr"])
            checks.compressed(name, parts[2], parts[1], parts[0], shape)
            return Block(scipy.sparse.csr_array(parts, shape=shape), arrays.get("variance"))

    def extra(self, name: str, array: Any = None) -> np.ndarray:
        """A small array by name: committed where `array` is given, else read and checked."""
        check_name(name)
        if array is not None:
            array = np.asarray(array)
            if array.dtype.kind not in "fiub":
                raise InputTypeError(f"{name} holds {array.dtype}; it must hold real numbers")
            with self._writing():
                self._log.put(f"extra.{name}", array=array)
            return array
        with about(self.path):
            if self._files is not None:
                return zarr_arrays.read_array(self.path, f"{self._place(f'extra/{name}')}/array", self._files)
            return self._log.get(f"extra.{name}")["array"]

    @property
    def extras(self) -> list[str]:
        """Names of the extra arrays."""
        prefix, names = ("extra/", self._places) if self.final else ("extra.", self._log.names)
        return sorted(name.removeprefix(prefix) for name in names if name.startswith(prefix))

    @property
    def attributes(self) -> dict[str, Any]:
        """Whatever the writer keeps with the store, plain JSON; read from the disk. See `update`."""
        with about(self.path):
            return dict(self._read_document())

    def update(self, **attributes: Any) -> None:
        """Change some of the `attributes`, at once or not at all; other processes' changes are kept."""
        with self._writing():
            self._write_document(self.layout, self.attributes | attributes, None)

    def finalize(
        self,
        *,
        memory: int = 1 << 28,
        sigmas: float = 0.0,
        change: Any = None,
        layout: Layout | None = None,
        extras: Mapping[str, np.ndarray] | None = None,
        state: Mapping[str, Any] | None = None,
    ) -> None:
        """Turn columns into rows, out of core; find the first bounce; close the store for good.

        Ended at any moment, it makes the same when called again. FileError names blocks that are missing.

        Parameters
        ----------
        memory : int
            Bytes for the entries that are turned at once.
        sigmas : float
            Standard deviations by which the diagonal has to be above 0 to be a first bounce.
        change : function, optional
            Of channel, first row, rows (rows, N) and the variance of their entries: what is kept of the two.
        layout, extras, state : Layout, dict, dict, optional
            Of the store from then on; arrays and attributes that join those it has. A layout of the kind
            "compressed" has extra arrays only.
        """
        self._refuse_reader()
        layout, more = layout or self.layout, extras or {}
        with about(self.path), locked(self.path):
            self._read_document()
            if not self.final:
                missing = self.missing() if layout.kind == "blocks" else []
                if missing:
                    listed = ", ".join(map(str, missing[:6])) + (" ..." if len(missing) > 6 else "")
                    raise FileError(
                        f"lacks {len(missing)} block(s) (channel, block) {listed}; resume the scan"
                    )
                rows = self._turned(memory, change) if layout.kind == "blocks" else ()
                there = ((name, self.extra(name)) for name in self.extras if name not in more)
                files = write_finished(self.path, layout, rows, (*more.items(), *there), sigmas)
                self._write_document(layout, self.attributes | dict(state or {}), files)
        self._clear()

    def verify(self) -> None:
        """Read everything and compare all checksums; the first thing that is wrong is raised as FileError."""
        with about(self.path):
            self._read_document()
            if self._files is not None:
                zarr_arrays.verify(self.path, self._files, passed=("log",))
            for name in self.extras:
                self.extra(name)
            for channel, block in sorted(self.written):
                self.block(channel, block)

    @property
    def _orientation(self) -> str:
        return "rows" if self.final else "columns"

    def _name(self, channel: int, block: int) -> str:
        most = {"channel": self.layout.channels - 1, "block": self.layout.blocks(self._orientation) - 1}
        for name, value in (("channel", channel), ("block", block)):
            checks.count(name, value, least=0, most=most[name])
        return f"columns_{channel}.{block:06d}"

    def _place(self, name: str) -> str:
        if name not in self._places:
            raise FileError(f"{name} is missing")
        return self._places[name]

    def _refuse_reader(self) -> None:
        if self.mode != "a":
            raise FileError(f"{self.path}: is open to read; open it with mode 'a' to write")

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """One process at a time, none once the store is final."""
        self._refuse_reader()
        with about(self.path), locked(self.path):
            self._read_document()
            if self.final:
                raise FileError("is final; nothing is written to it any more")
            yield

    def _read_document(self) -> dict[str, Any]:
        """Everything that zarr.json says; returns the attributes of the writer."""
        attributes = zarr_arrays.unseal(zarr_arrays.read_file(self.path, "zarr.json"), "zarr.json")
        self.layout = Layout.from_json(attributes.get("ltcl"))
        parts = [attributes.get(name) or {} for name in ("provenance", "state", "final", "files")]
        if not all(isinstance(part, dict) for part in parts):
            raise FileError("zarr.json has provenance, state or files that are no objects")
        self.provenance: dict[str, Any] = parts[0]
        self._files: dict[str, str] | None = attributes.get("files")
        if attributes["ltcl"]["schema"] == 1:
            if not parts[2]:
                raise FileError(
                    "was begun by an earlier ltcl and is not finished; finish it with that version"
                )
            self._files = zarr_arrays.manifest_1(self.path, parts[2])
        folders = {"/".join(name.split("/")[:2]) for name in self._files or () if name.count("/") > 1}
        self._places = {name.rpartition(".")[0]: name for name in folders}
        return parts[1]

    def _write_document(self, layout: Layout, state: Mapping[str, Any], files: Any) -> None:
        raw = document(layout, self.provenance, state, files)
        with replace_file(self.path / "zarr.json") as temporary:
            temporary.write_bytes(raw)
        self._read_document()

    def _clear(self) -> None:
        if self.final:
            shutil.rmtree(self._log.path, ignore_errors=True)

    def _turned(self, memory: int, change: Any) -> Iterator[tuple[int, int, Block]]:
        """All blocks of rows; as many as fit the memory are gathered in one pass over the columns."""
        most = checks.count("memory", memory, least=_PER_ENTRY) // _PER_ENTRY
        for channel in range(self.layout.channels):
            for first, last in _batches(self._entries(channel), most):
                start, stop = self.layout.span(first)[0], self.layout.span(last)[1]
                T, V = self._gathered(channel, start, stop)
                for block in range(first, last + 1):
                    top, bottom = (place - start for place in self.layout.span(block))
                    rows, variance = T[top:bottom], None if V is None else V[top:bottom].data
                    if change is not None:
                        rows, variance = change(channel, start + top, rows, variance)
                    yield channel, block, _checked(rows, variance, self.layout.block_shape(block))

    def _entries(self, channel: int) -> np.ndarray:
        """Entries of each block of rows."""
        counts = np.zeros(self.layout.blocks(), np.int64)
        for block in range(self.layout.blocks("columns")):
            rows = self.read(channel, block).indices // self.layout.block_rows
            counts += np.bincount(rows, minlength=len(counts))
        return counts

    def _gathered(self, channel: int, start: int, stop: int) -> tuple[Any, Any]:
        """Rows start .. stop - 1 of T, and their variance: NaN of columns without one, None if none has."""
        values, variances, known = [], [], False
        for block in range(self.layout.blocks("columns")):
            C, variance = self.block(channel, block)
            known |= variance is not None
            values.append(C[:, start:stop])
            V = np.full(C.nnz, np.nan, np.float32) if variance is None else variance
            variances.append(scipy.sparse.csr_array((V, C.indices, C.indptr), shape=C.shape)[:, start:stop])
        T, V = (scipy.sparse.vstack(parts, "csr").T.tocsr() for parts in (values, variances))
        return T, V if known else None


def write_finished(
    root: Path,
    layout: Layout,
    rows: Iterable[tuple[int, int, Block]],
    extras: Iterable[tuple[str, np.ndarray]],
    sigmas: float = 0.0,
) -> dict[str, str]:
    """Write T and all small arrays by zarr into `root`, flushed; returns their manifest."""
    groups = ["extra", *(f"channel_{c}" for c in range(layout.channels))]
    for group in groups:
        shutil.rmtree(root / group, ignore_errors=True)  # of a process that ended here
        zarr_arrays.write_group(root / group, {}, {})
    F = np.zeros((layout.channels, layout.shape[1]))
    for channel, block, part in rows:
        zarr_arrays.write_rows(root, channel, block, part, layout.dtype)
        if layout.is_square:
            F[channel, slice(*layout.span(block))] = _diagonal(part, layout.span(block)[0], sigmas)
    small = dict(extras)
    if layout.kind == "blocks" and layout.is_square and "first_bounce" not in small:
        small |= {"first_bounce": F, "masked": np.asarray((F <= 0).any(axis=0))}
    for name, array in small.items():
        zarr_arrays.write_group(root / "extra" / f"{name}.0", {"array": array}, {})
    for group in groups:
        flush_tree(root / group)
    return zarr_arrays.manifest(root, groups)


def document(
    layout: Layout, provenance: Mapping[str, Any], state: Mapping[str, Any], files: Mapping[str, str] | None
) -> bytes:
    """The zarr.json of a store; `files` of a final one."""
    from ltcl import __version__  # here, because it is set after this module is imported

    versions = {"ltcl": __version__, "numpy": np.__version__, "scipy": scipy.__version__}
    attributes = {
        "ltcl": {"schema": SCHEMA, **asdict(layout)},
        "provenance": {"versions": versions, **provenance},
        "state": dict(state),
    }
    return zarr_arrays.seal(attributes if files is None else attributes | {"files": dict(files)})


def check_place(path: Path, overwrite: bool) -> None:
    """Refuse at once, before there is anything to keep, a place where no store can be made."""
    target = Path(os.path.realpath(path))
    with about(path):
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


def rows_at_once(shape: tuple[int, int]) -> int:
    """Rows of a block unless told otherwise: 64 MiB if none of its entries were 0.

    >>> rows_at_once((4096, 4096)), rows_at_once((3, 5))
    (2048, 3)
    """
    return max(1, min(shape[0], _FILL // (8 * shape[1])))


def _checked(matrix: Any, variance: Any, shape: tuple[int, int]) -> Block:
    """What is to be written, as float32; refused before anything is."""
    matrix = checks.csr("matrix", matrix)
    checks.shape("matrix", matrix, shape)
    with np.errstate(over="ignore"):
        values = checks.finite("matrix as float32", matrix.data.astype(np.float32))
    if scipy.sparse.issparse(variance):
        other = checks.csr("variance", variance)
        if not (
            np.array_equal(other.indptr, matrix.indptr) and np.array_equal(other.indices, matrix.indices)
        ):
            raise InputError("variance has its entries in other places than matrix; it must have the same")
        variance = other.data
    if variance is not None:
        variance = checks.shape("variance", checks.real("variance", variance), (matrix.nnz,))
        if np.any(variance < 0) or np.any(np.isinf(variance)):
            raise InputError("variance is negative or infinite; it must be at least 0, or NaN where unknown")
        variance = variance.astype(np.float32)
    return Block(scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=shape), variance)


def _diagonal(rows: Block, start: int, sigmas: float) -> np.ndarray:
    """First bounce of the pixels whose rows start at `start`; 0 where it does not stand out of the noise."""
    T, F = rows.matrix, rows.matrix.diagonal(start)
    if rows.variance is None or sigmas <= 0:
        return F
    V = scipy.sparse.csr_array((rows.variance, T.indices, T.indptr), shape=T.shape)
    return first_bounce.certain(F, V.diagonal(start), sigmas)


def _batches(sizes: np.ndarray, most: int) -> Iterator[tuple[int, int]]:
    """Runs (first, last) of blocks that together have at most `most` entries, or one block."""
    first, total = 0, 0
    for block, size in enumerate(sizes.tolist()):
        if block > first and total + size > most:
            yield first, block - 1
            first, total = block, 0
        total += size
    yield first, len(sizes) - 1
