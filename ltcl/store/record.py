# SPDX-License-Identifier: BSD-3-Clause
"""Contents of transport files: `StoreRecord` of matrices, `CompressedRecord` of operators."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.files import read_ahead
from ltcl.store.guards import floats
from ltcl.transport.matrices import check_mixing
from ltcl.transport.noise import Noise

if TYPE_CHECKING:
    from ltcl.store.block_store import BlockStore

EXTRAS = ("grid", "camera_grid", "first_bounce", "mixing")
CSR = ("data", "indices", "indptr")
CHANNELS = ("T_0", "T_1", "T_2")
COMPRESSED_FORMAT = "ltcl-compressed-1"
INVERSE_FORMAT = "ltcl-inverse-1"
# Arrays with these endings are infinite where their values are unknown.
MAYBE_INFINITE = (".solution_error", ".error_bound", "noise_white")
INDEX_BYTES = 4
POINTER_BYTES = 8


class StoredRows(scipy.sparse.linalg.LinearOperator):
    """T (M, N) of one channel of a final `BlockStore`; all blocks are checked once, here.

    On a device it becomes compressed sparse rows, a block at a time. `nnz` counts its entries, and
    `nbytes` are those on the disk.
    """

    def __init__(self, store: BlockStore, channel: int) -> None:
        sizes = store.layout
        super().__init__(np.dtype(sizes.dtype), sizes.shape)
        self._store = store
        self._channel = channel
        self._cached: tuple[int, scipy.sparse.csr_array] | None = None
        self.nnz = 0
        for block in range(sizes.blocks()):
            self.nnz += self._block(block).nnz
        entry_bytes = INDEX_BYTES + np.dtype(sizes.dtype).itemsize
        pointers = self.shape[0] + sizes.blocks()
        self.nbytes = entry_bytes * self.nnz + POINTER_BYTES * pointers

    def _block(self, block: int) -> scipy.sparse.csr_array:
        """A checked block; the last one is kept."""
        cached = self._cached  # another thread may replace it
        if cached is not None and cached[0] == block:
            return cached[1]
        matrix = self._store.block(self._channel, block).matrix
        self._cached = block, matrix
        return matrix

    def row_blocks(self) -> Iterator[tuple[int, scipy.sparse.csr_array]]:
        """First row and rows of each block."""
        blocks = range(self._store.layout.blocks())
        return read_ahead(lambda block: self._store.rows_again(self._channel, block), blocks)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        size = self._store.layout.block_rows
        slices = []
        for block in range(start // size, -(-stop // size)):
            first = block * size
            rows = self._block(block)[max(start - first, 0) : stop - first]
            slices.append(rows.toarray())
        return np.concatenate(slices)

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries where ascending `rows` meet `columns`, (len(rows), len(columns)) float64."""
        entries = [self.rows(row, row + 1)[:, columns] for row in rows.tolist()]
        return np.concatenate(entries).astype(np.float64)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),)."""
        diagonals = []
        for first, block in self.row_blocks():
            if first < self.shape[1]:
                diagonals.append(block.diagonal(first))
        return np.concatenate(diagonals)[: min(self.shape)]

    def tocsr(self) -> scipy.sparse.csr_array:
        """The whole matrix in memory; MemoryLimitError where it does not fit."""
        checks.fits_host(f"T of {self.nnz} entries", 2 * self.nbytes)
        blocks = [block for _, block in self.row_blocks()]
        return scipy.sparse.csr_array(scipy.sparse.vstack(blocks, "csr"))

    def _matmat(self, X: Any) -> np.ndarray:
        return np.concatenate([block @ X for _, block in self.row_blocks()])

    def _rmatmat(self, X: Any) -> np.ndarray:
        product = np.zeros((self.shape[1], X.shape[1]))
        for first, block in self.row_blocks():
            rows = len(block.indptr) - 1
            product += block.T @ X[first : first + rows]
        return product


Matrix = np.ndarray | scipy.sparse.csr_array | StoredRows
# Name of an array, or names of three, "red,green,blue"; None takes the default.
Variable = str | Sequence[str] | None


@dataclass(frozen=True)
class StoreRecord:
    """Contents of a transport file, `picture = T @ pattern`.

    Parameters
    ----------
    matrices : tuple of one, or three of colours
        Arrays, `csr_array` or `StoredRows` of M camera and N projector pixels.
    grid, camera_grid : (h, w), optional
    first_bounce : (N,) or (3, N), optional
    mixing : (3, 3), optional
    noise : Noise, optional

    Raises
    ------
    InputError, InputTypeError
        They do not fit each other.
    """

    matrices: tuple[Any, ...]
    grid: tuple[int, int] | None = None
    camera_grid: tuple[int, int] | None = None
    first_bounce: np.ndarray | None = None
    mixing: np.ndarray | None = None
    noise: Noise | None = None

    def __post_init__(self) -> None:
        types = {type(matrix) for matrix in self.matrices}
        has_channels = len(self.matrices) in (1, 3)
        if not has_channels or len(types) > 1 or not isinstance(self.matrices[0], Matrix):
            names = [type(matrix).__name__ for matrix in self.matrices]
            raise InputTypeError(
                f"matrices are {names}; they must be one or three arrays or csr_array"
            )
        shapes = {tuple(matrix.shape or ()) for matrix in self.matrices}
        shape = min(shapes)
        if len(shapes) > 1 or len(shape) != 2 or 0 in shape:
            shapes = sorted(shapes)
            raise InputError(
                f"matrices have the shapes {shapes}; they must be one (M, N), not empty"
            )
        if self.first_bounce is not None:
            pixels = self.shape[1]
            checks.shape("first_bounce", self.first_bounce, (pixels,), (3, pixels))
        if self.mixing is not None:
            check_mixing(self.mixing, len(self.matrices), has_blocks=False)

    @property
    def shape(self) -> tuple[int, int]:
        """(M, N): camera pixels, projector pixels."""
        return self.matrices[0].shape

    @property
    def dense(self) -> bool:
        """True if the matrices are arrays."""
        return isinstance(self.matrices[0], np.ndarray)

    @property
    def stored(self) -> bool:
        """True if the matrices are rows of a store."""
        return isinstance(self.matrices[0], StoredRows)

    def in_memory(self) -> StoreRecord:
        """The same with a store's blocks all loaded; as arrays where every entry is stored."""
        if not self.stored:
            return self
        matrices = [matrix.tocsr() for matrix in self.matrices]
        entries = sum(matrix.nnz for matrix in matrices)
        if entries == len(matrices) * math.prod(self.shape):
            matrices = [matrix.toarray() for matrix in matrices]
        return replace(self, matrices=tuple(matrices))

    def arrays(self) -> dict[str, Any]:
        """Named arrays: `EXTRAS`, those of noise, and T (M, N) or (3, M, N) where that is dense."""
        arrays: dict[str, Any] = {}
        if self.dense:
            arrays["T"] = self.matrices[0]
            if len(self.matrices) == 3:
                arrays["T"] = np.stack(self.matrices)
        for name in EXTRAS:
            value = getattr(self, name)
            if value is not None:
                arrays[name] = np.asarray(value)
        if self.noise is not None:
            for name, value in self.noise.to_arrays().items():
                arrays[name] = np.asarray(value)
        return arrays


@dataclass(frozen=True, kw_only=True)
class FileNames:
    """Names that a format gives to T and its channels, and the order of its axes."""

    matrix: str = "T"
    channels: tuple[str, ...] = CHANNELS
    is_reversed: bool = False


DEFAULT_NAMES = FileNames()
# Ends of names by which three matrices of a file are its channels.
COLOUR_WORDS = (("red", "green", "blue"), ("r", "g", "b"))


@dataclass(frozen=True, kw_only=True)
class FileContents:
    """Arrays that a file holds by name, and how to read one of them.

    `unreadable` tells of all else in the file why it cannot be T, such as "complex".
    """

    shapes: Mapping[str, tuple[int, ...]]
    load: Callable[[str], Any]
    unreadable: Mapping[str, str] = field(default_factory=dict)


def assemble(
    contents: FileContents,
    variable: Variable = None,
    names: FileNames = DEFAULT_NAMES,
) -> StoreRecord:
    """Make a record of the arrays that a file holds by name.

    T is the array `variable`, or three of them; else that of `names`, its three channels, or the
    only matrix in the file.
    """
    shapes = contents.shapes
    load = contents.load
    if variable is None:
        matrix_names = _matrix_names(contents, names)
    else:
        matrix_names = _chosen_names(contents, variable)
    matrices = [load(name) for name in matrix_names]
    extras: dict[str, Any] = {}
    for name in ("first_bounce", "mixing"):
        if name in shapes:
            extras[name] = floats(name, load(name))
    for name in ("grid", "camera_grid"):
        if name in shapes:
            extras[name] = checks.grid(f"array {name!r}", load(name).ravel().tolist())
    noise_arrays = {name: load(name) for name in shapes if name.startswith("noise_")}
    extras["noise"] = Noise.from_arrays(noise_arrays)
    if isinstance(matrices[0], np.ndarray):
        _check_dense(matrices, matrix_names[0], shapes, names)
        matrices = [floats("T", matrix) for matrix in matrices]
        if matrices[0].ndim == 3:
            matrices = list(matrices[0])
    if names.is_reversed and "first_bounce" in extras:
        extras["first_bounce"] = _one_channel(extras["first_bounce"], matrices[0].shape)
    return StoreRecord(tuple(matrices), **extras)


def _one_channel(first_bounce: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The first bounce of MATLAB, where one channel is a row or a column of N values, as (N,)."""
    if first_bounce.size == shape[-1]:
        return first_bounce.ravel()
    return first_bounce


def _chosen_names(contents: FileContents, variable: str | Sequence[str]) -> Sequence[str]:
    """Names of the arrays that the user chose as T: one, or three of them, "red,green,blue"."""
    if not isinstance(variable, str):
        chosen = list(variable)
    elif variable in contents.shapes:
        chosen = [variable]
    else:
        chosen = [name.strip().lstrip("/") for name in variable.split(",")]
    if len(chosen) not in (1, 3):
        raise InputError(f"variable is {variable!r:.100}; it must be one name, or three of colours")
    for name in chosen:
        if name in contents.unreadable:
            raise _unreadable(contents, name)
        if name not in contents.shapes:
            present = [*contents.shapes, *contents.unreadable] or ["none"]
            listed = ", ".join(present)
            raise FileError(f"variable {name!r} is missing; it holds {listed:.200}")
    return chosen


def _unreadable(contents: FileContents, name: str) -> FileError:
    kind = contents.unreadable[name]
    return FileError(f"{name!r} is {kind}; T must be an array of real numbers")


def _matrix_names(contents: FileContents, names: FileNames) -> Sequence[str]:
    """Names of the arrays that are T, one or three."""
    shapes = contents.shapes
    if names.matrix in shapes:
        return [names.matrix]
    if names.matrix in contents.unreadable:
        raise _unreadable(contents, names.matrix)
    if set(names.channels) <= set(shapes):
        return names.channels
    matrices = []
    listed = []
    step = -1 if names.is_reversed else 1  # axes as the user knows them
    for name, shape in shapes.items():
        if name in EXTRAS or name.startswith("noise_"):
            continue
        listed.append(f"{name!r} {shape[::step]}")
        if _is_matrix(shape):
            matrices.append(name)
    if len(matrices) == 1:
        return matrices
    colours = _colours(matrices)
    if colours:
        return colours
    for name, kind in contents.unreadable.items():
        listed.append(f"{name!r} ({kind})")
    if not shapes:
        listed.insert(0, "no numbers")
    raise FileError(
        f"holds {', '.join(listed):.300}; it must hold {names.matrix} of (M, N) or of three "
        "channels, or one matrix by another name; variable= names one of several, or three of them "
        "(red,green,blue)"
    )


def _colours(matrices: Sequence[str]) -> Sequence[str]:
    """Sort the names of three matrices of colours, such as T_red; empty if they are not."""
    if len(matrices) != 3:
        return ()
    for words in COLOUR_WORDS:
        sorted_names = []
        stems = set()
        for word in words:
            for name in matrices:
                if name.lower().endswith(word):
                    sorted_names.append(name)
                    stems.add(name.lower().removesuffix(word))
        if len(sorted_names) == 3 and len(stems) == 1:
            return sorted_names
    return ()


def _check_dense(
    matrices: Sequence[np.ndarray],
    name: str,
    shapes: Mapping[str, tuple[int, ...]],
    names: FileNames,
) -> None:
    for matrix in matrices:
        if _is_matrix(matrix.shape) and (len(matrices) == 1 or matrix.ndim == 2):
            continue
        shape = matrix.shape
        order = "(3, M, N)"
        if names.is_reversed:
            shape = shapes[name][::-1]
            order = "(M, N, 3)"
        raise FileError(f"{name} has shape {shape}; it must be (M, N) or {order}, not empty")


def _is_matrix(shape: tuple[int, ...]) -> bool:
    """True if an array may be T: (M, N), or one or three of them."""
    if 0 in shape:
        return False
    return len(shape) == 2 or (len(shape) == 3 and shape[0] in (1, 3))


@dataclass(frozen=True, eq=False)
class CompressedRecord:
    """Arrays of a compressed transport or, by its `format`, of an inverse.

    Names are those of `ltcl.transport`. InputError if the arrays do not fit each other, or are not
    finite; operators are checked where they are made.
    """

    arrays: Mapping[str, np.ndarray]
    format: str = COMPRESSED_FORMAT
    camera_grid = None

    def __post_init__(self) -> None:
        missing = {"grid", "first_bounce", "system_0.R.kind"} - self.arrays.keys()
        if missing:
            raise InputError(
                f"a compressed transport has the array {min(missing)!r}, which is missing"
            )
        F = self.first_bounce
        allowed = [(channels, *F.shape[1:2]) for channels in (1, 3)]
        checks.shape("first_bounce", F, *allowed)
        grid = checks.shape("grid", self.arrays["grid"], (2,))
        checks.grid("grid", grid.tolist(), F.shape[1])
        for name, array in self.arrays.items():
            if array.dtype.kind == "f" and not name.endswith(MAYBE_INFINITE):
                checks.finite(f"array {name!r}", array)
        if self.mixing is not None:
            check_mixing(self.mixing, len(F), has_blocks=False)

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of projector and camera."""
        return tuple(self.arrays["grid"].tolist())

    @property
    def first_bounce(self) -> np.ndarray:
        """F, (channels, N)."""
        return self.arrays["first_bounce"]

    @property
    def mixing(self) -> np.ndarray | None:
        """Mixing of the projector's colours, (3, 3), where that is known."""
        return self.arrays.get("mixing")

    @property
    def shape(self) -> tuple[int, int]:
        """(N, N)."""
        pixels = self.first_bounce.shape[1]
        return pixels, pixels

    @property
    def error(self) -> float:
        """Relative error of solutions, as a compression states it; the largest of all channels."""
        largest = 0.0
        for array in self._ending_with(".solution_error", "errors"):
            if array.dtype.kind in "fiu":
                largest = max(largest, float(np.max(array, initial=0.0)))
        return largest

    @property
    def nbytes(self) -> int:
        """Bytes of the operators, as they are stored."""
        total = 0
        for name, array in self.arrays.items():
            if name.startswith(("system_", "basis_")):
                total += array.nbytes
        return total

    @property
    def entries(self) -> int:
        """Number of values that are not 0, in all cores."""
        values = self._ending_with(".data", ".codes", ".matrix")
        return int(sum(map(np.count_nonzero, values)))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the cores and bases, each once."""
        names = map(str, self._ending_with(".kind") + self._ending_with(".name"))
        kinds = dict.fromkeys(names)
        for composition in ("compressed", "sum"):
            kinds.pop(composition, None)
        return tuple(kinds)

    def _ending_with(self, *endings: str) -> list[np.ndarray]:
        return [array for name, array in self.arrays.items() if name.endswith(endings)]
