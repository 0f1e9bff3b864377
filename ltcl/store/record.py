# SPDX-License-Identifier: BSD-3-Clause
"""Transports as files hold them, and the checks of what a file declares before memory is taken for it.

SciPy, NumPy, h5py and zarr allocate what a header asks for, and raise nearly everything where bytes
are damaged: so their callers call `declared` first, inside of `about`.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import FileError, InputError, InputTypeError, LtclError, MemoryLimitError
from ltcl.files import read_ahead
from ltcl.transport.matrices import check_mixing
from ltcl.transport.noise import Noise

EXTRAS = ("grid", "camera_grid", "first_bounce", "mixing")
CSR = ("data", "indices", "indptr")
CHANNELS = ("T_0", "T_1", "T_2")
_MAYBE_INFINITE = (".solution_error", ".error_bound", "noise_white")  # where they are unknown
EXPANSION = 1032  # what deflate can reach, the only compression that is read


@contextlib.contextmanager
def about(path: Any, *, reading: bool = False) -> Iterator[None]:
    """Put the name of `path` in front of each refusal in the block; in `reading`, any exception is one."""
    try:
        yield
    except (InputError, InputTypeError) as error:
        if isinstance(error, FileError) and str(error).startswith(str(path)):
            raise
        raise FileError(f"{path}: {error}") from error.__cause__
    except MemoryError as error:
        raise MemoryLimitError(f"{path}: {error or 'the host has no memory left'}") from None
    except Exception as error:
        if isinstance(error, LtclError) or not (reading or isinstance(error, OSError)):
            raise
        reason = (
            getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        )
        damage = "" if isinstance(error, OSError) else "is damaged or truncated: "
        raise FileError(f"{path}: {damage}{reason:.150}") from error


def declared(what: str, dtype: np.dtype, shape: tuple[int, ...], most: int, least: int = 0) -> None:
    """Refuse an array whose declared bytes are not `least` .. `most`, or too many for the host."""
    nbytes = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or not least <= nbytes <= most:
        size = f"{dtype.newbyteorder('=')} {shape}, {checks.size(nbytes)}"
        raise FileError(
            f"{what} is declared as {size}, but {checks.size(most)} ({most} bytes) are stored"
        )
    checks.fits_host(f"{what} {shape}", 2 * nbytes)


def floats(what: str, array: np.ndarray) -> np.ndarray:
    """Real values as float32 where that is exact by type (16 bits and fewer, float32), else as float64."""
    dtype = np.float32 if np.result_type(array.dtype, np.float32) == np.float32 else np.float64
    return np.ascontiguousarray(checks.real(what, array), dtype)


def sparse(make: Callable[[], Any], shape: Sequence[int], entries: int) -> scipy.sparse.csr_array:
    """A matrix of SciPy in any layout as checked rows of floats, made after its sizes are checked."""
    most = (
        1 << 24
    ) + 64 * entries  # 128 MiB of pointers; more rows must have entries to show for them
    if min(shape) < 1 or max(shape) > most:
        raise FileError(
            f"the matrix is declared as {tuple(shape)}, {entries} entries; it must be 1..{most}"
        )
    matrix = make()
    if matrix.format == "bsr":
        matrix.check_format(
            full_check=True
        )  # the others are checked in `checks.csr`, or when they are made
    csr = checks.csr("the matrix", matrix)
    return scipy.sparse.csr_array(
        (floats("data", csr.data), csr.indices, csr.indptr), shape=csr.shape
    )


class StoredRows(scipy.sparse.linalg.LinearOperator):
    """T (M, N) of a channel of a final `BlockStore`, read block by block; all are checked once, here.

    On a device it becomes compressed sparse rows, a block at a time. `nbytes` are those on the
    disk.
    """

    def __init__(self, store: Any, channel: int) -> None:
        self._layout = sizes = store.layout
        super().__init__(np.dtype(sizes.dtype), sizes.shape)
        self._read = functools.lru_cache(1)(lambda block: store.block(channel, block).matrix)
        self.nnz = sum(self._read(block).nnz for block in range(sizes.blocks()))
        self._again = functools.partial(store.rows_again, channel)
        self.nbytes = (4 + np.dtype(sizes.dtype).itemsize) * self.nnz + 8 * (
            self.shape[0] + sizes.blocks()
        )

    def row_blocks(self) -> Iterator[tuple[int, scipy.sparse.csr_array]]:
        """Each block with its first row."""
        return read_ahead(self._again, range(self._layout.blocks()))

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        size = self._layout.block_rows
        blocks = range(start // size, -(-stop // size))
        slices = (
            self._read(k)[max(start - k * size, 0) : stop - k * size].toarray() for k in blocks
        )
        return np.concatenate(list(slices))

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries where ascending `rows` meet `columns`, (len(rows), len(columns)) float64."""
        return np.concatenate([self.rows(i, i + 1)[:, columns] for i in rows.tolist()]).astype(
            np.float64
        )

    def diagonal(self) -> np.ndarray:
        """The main diagonal."""
        diagonals = [
            block.diagonal(first) for first, block in self.row_blocks() if first < self.shape[1]
        ]
        return np.concatenate(diagonals)[: min(self.shape)]

    def tocsr(self) -> scipy.sparse.csr_array:
        """All of it in memory."""
        checks.fits_host(f"T of {self.nnz} entries", 2 * self.nbytes)
        return scipy.sparse.csr_array(
            scipy.sparse.vstack([block for _, block in self.row_blocks()], "csr")
        )

    def _matmat(self, X: Any) -> np.ndarray:
        return np.concatenate([block @ X for _, block in self.row_blocks()])

    def _rmatmat(self, X: Any) -> np.ndarray:
        blocks = (
            block.T @ X[first : first + len(block.indptr) - 1] for first, block in self.row_blocks()
        )
        return sum(blocks, np.zeros((self.shape[1], X.shape[1])))


Matrix = np.ndarray | scipy.sparse.csr_array | StoredRows


@dataclass(frozen=True)
class Record:
    """Contents of a transport file, `picture = T @ pattern`; InputError where they do not fit each other.

    `matrices` are one, or three of colours, of M camera and N projector pixels: arrays, `csr_array`
    or `StoredRows`; `grid` and `camera_grid` are (h, w), `first_bounce` (N,) or (3, N), `mixing`
    (3, 3).
    """

    matrices: tuple[Any, ...]
    grid: tuple[int, int] | None = None
    camera_grid: tuple[int, int] | None = None
    first_bounce: np.ndarray | None = None
    mixing: np.ndarray | None = None
    noise: Noise | None = None

    def __post_init__(self) -> None:
        types, shapes = (
            {type(T) for T in self.matrices},
            {tuple(T.shape or ()) for T in self.matrices},
        )
        if (
            len(self.matrices) not in (1, 3)
            or len(types) > 1
            or not isinstance(self.matrices[0], Matrix)
        ):
            names = [type(T).__name__ for T in self.matrices]
            raise InputTypeError(
                f"matrices are {names}; they must be one or three arrays or csr_array"
            )
        if len(shapes) > 1 or any(len(shape) != 2 or 0 in shape for shape in shapes):
            raise InputError(
                f"matrices have the shapes {sorted(shapes)}; they must be one (M, N), not empty"
            )
        if self.first_bounce is not None:
            checks.shape("first_bounce", self.first_bounce, (self.shape[1],), (3, self.shape[1]))
        if self.mixing is not None:
            check_mixing(self.mixing, len(self.matrices), has_blocks=False)

    shape = property(
        lambda self: self.matrices[0].shape, doc="(M, N): camera pixels, projector pixels."
    )
    dense = property(
        lambda self: isinstance(self.matrices[0], np.ndarray), doc="Whether they are arrays."
    )
    stored = property(
        lambda self: isinstance(self.matrices[0], StoredRows), doc="Whether in a store."
    )

    def in_memory(self) -> Record:
        """The same, of a store's blocks all loaded; as arrays where every entry is stored."""
        every = self.stored and all(T.nnz == math.prod(T.shape) for T in self.matrices)
        matrices = (T.tocsr() if self.stored else T for T in self.matrices)
        return replace(self, matrices=tuple(T.toarray() if every else T for T in matrices))

    def arrays(self) -> dict[str, Any]:
        """Named arrays: `EXTRAS`, those of noise, and T (M, N) or (3, M, N) where that is dense."""
        T = self.matrices
        values = {"T": (T[0] if len(T) == 1 else np.stack(T)) if self.dense else None}
        values |= {n: getattr(self, n) for n in EXTRAS} | (
            self.noise.to_arrays() if self.noise else {}
        )
        return {name: np.asarray(value) for name, value in values.items() if value is not None}


def assemble(
    shapes: Any, load: Any, variable: str | None = None, name="T", channels=CHANNELS, reverse=False
) -> Record:
    """A record of what a file holds by name: T is `variable`, else `name`, `channels`, or the only matrix."""
    if variable not in (None, *shapes):
        raise FileError(
            f"variable {variable!r} is missing; it holds {', '.join(shapes) or 'none':.200}"
        )
    others = {
        o: shape for o, shape in shapes.items() if o not in EXTRAS and not o.startswith("noise_")
    }
    names: Sequence[str] = [variable or name]
    if variable is None and name not in shapes:
        names = [other for other, shape in others.items() if _is_matrix(shape)]
        names = channels if set(channels) <= set(shapes) else names
        if len(names) != 1 and names is not channels:
            step = -1 if reverse else 1  # axes as the user knows them
            content = (
                ", ".join(f"{n!r} {shape[::step]}" for n, shape in others.items()) or "no numbers"
            )
            text = (
                f"it must hold {name} of (M, N) or of three channels, or one matrix by another name"
            )
            raise FileError(f"holds {content:.300}; {text}; variable= names one of several")
    matrices = [load(name) for name in names]
    extras: dict[str, Any] = {
        n: floats(n, load(n)) for n in ("first_bounce", "mixing") if n in shapes
    }
    for grid in {"grid", "camera_grid"} & set(shapes):
        extras[grid] = checks.grid(f"array {grid!r}", load(grid).ravel().tolist())
    extras["noise"] = Noise.from_arrays({n: load(n) for n in shapes if n.startswith("noise_")})
    if isinstance(matrices[0], np.ndarray):
        if wrong := [T.shape for T in matrices if not _is_matrix(np.shape(T))]:
            shape, order = (
                (shapes[names[0]][::-1], "(M, N, 3)") if reverse else (wrong[0], "(3, M, N)")
            )
            raise FileError(
                f"{names[0]} has shape {shape}; it must be (M, N) or {order}, not empty"
            )
        matrices = [floats("T", T) for T in matrices]
        matrices = list(matrices[0]) if matrices[0].ndim == 3 else matrices
    return Record(tuple(matrices), **extras)


def _is_matrix(shape: tuple[int, ...]) -> bool:
    return 0 not in shape and (len(shape) == 2 or (len(shape) == 3 and shape[0] in (1, 3)))


@dataclass(frozen=True, eq=False)
class Parts:
    """Arrays of a compressed transport, or by its `format` of an inverse, by the names of `ltcl.transport`.

    InputError where they do not fit, or are not finite; operators are checked where they are made.
    """

    arrays: Mapping[str, np.ndarray]
    format: str = "ltcl-compressed-1"
    camera_grid = None

    def __post_init__(self) -> None:
        if missing := {"grid", "first_bounce", "system_0.R.kind"} - self.arrays.keys():
            raise InputError(
                f"a compressed transport has the array {min(missing)!r}, which is missing"
            )
        F = self.first_bounce
        checks.shape("first_bounce", F, *((channels, *F.shape[1:2]) for channels in (1, 3)))
        checks.grid("grid", checks.shape("grid", self.arrays["grid"], (2,)).tolist(), F.shape[1])
        for name, array in self.arrays.items():
            if array.dtype.kind == "f" and not name.endswith(_MAYBE_INFINITE):
                checks.finite(f"array {name!r}", array)
        if self.mixing is not None:
            check_mixing(self.mixing, len(F), has_blocks=False)

    grid = property(
        lambda self: tuple(self.arrays["grid"].tolist()), doc="(h, w) of projector and camera."
    )
    first_bounce = property(lambda self: self.arrays["first_bounce"], doc="F, (channels, N).")
    mixing = property(
        lambda self: self.arrays.get("mixing"), doc="Of the projector's colours, (3, 3)."
    )
    shape = property(lambda self: (self.first_bounce.shape[1],) * 2, doc="(N, N).")

    def _ending(self, *ends: str) -> list[np.ndarray]:
        return [array for name, array in self.arrays.items() if name.endswith(ends)]

    @property
    def error(self) -> float:
        """Relative error of solutions, as a compression states it; the largest of all channels."""
        errors = self._ending(".solution_error", "errors")
        return max(
            (float(np.max(a, initial=0.0)) for a in errors if a.dtype.kind in "fiu"), default=0.0
        )

    @property
    def nbytes(self) -> int:
        """Bytes of the operators, as they are stored."""
        return sum(
            a.nbytes for name, a in self.arrays.items() if name.startswith(("system_", "basis_"))
        )

    @property
    def entries(self) -> int:
        """Values that are not 0, of all cores."""
        return sum(
            int(np.count_nonzero(array)) for array in self._ending(".data", ".codes", ".matrix")
        )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the cores and bases, each once."""
        names = dict.fromkeys(map(str, self._ending(".kind") + self._ending(".name")))
        return tuple(name for name in names if name not in ("compressed", "sum"))
