# SPDX-License-Identifier: BSD-3-Clause
"""Transports as files hold them: `Record`, plain host arrays, and `Parts`, of a compressed one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks, layout
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.store import headers
from ltcl.store.rows import StoredRows

Matrix = np.ndarray | scipy.sparse.csr_array | StoredRows
EXTRAS = ("grid", "camera_grid", "first_bounce", "mixing")
_MAY_BE_INFINITE = ".solution_error"


@dataclass(frozen=True)
class Record:
    """Contents of a transport file, `picture = T @ pattern`; InputError where they do not fit each other.

    Attributes
    ----------
    matrices
        One matrix, or three for red, green and blue, each (M, N): M camera pixels, N projector pixels, both
        row-major. All dense, all `csr_array` or all `StoredRows`, real.
    grid, camera_grid
        (h, w) of projector and camera, or None where the file does not tell.
    first_bounce, mixing
        Direct light per pixel, (N,) or (3, N), and the mixing (3, 3) of the projector's colours, or None.

    Examples
    --------
    >>> Record((np.eye(6),), grid=(2, 3)).shape
    (6, 6)
    """

    matrices: tuple[Matrix, ...]
    grid: tuple[int, int] | None = None
    camera_grid: tuple[int, int] | None = None
    first_bounce: np.ndarray | None = None
    mixing: np.ndarray | None = None

    def __post_init__(self) -> None:
        if len(self.matrices) not in (1, 3):
            raise InputError(f"matrices are {len(self.matrices)}; they must be one, or three for RGB")
        kinds, shapes = {type(T) for T in self.matrices}, {tuple(T.shape or ()) for T in self.matrices}
        if len(kinds) > 1 or not isinstance(self.matrices[0], Matrix):
            names = ", ".join(type(T).__name__ for T in self.matrices)
            raise InputTypeError(f"matrices are {names}; they must be all arrays or all csr_array")
        if len(shapes) > 1 or any(len(shape) != 2 or 0 in shape for shape in shapes):
            raise InputError(f"matrices have the shapes {sorted(shapes)}; they must be one (M, N), not empty")
        if self.first_bounce is not None:
            columns = self.shape[1]
            checks.shape("first_bounce", self.first_bounce, (columns,), (3, columns))
        if self.mixing is not None:
            layout.mixing(self.mixing, len(self.matrices), None)

    @property
    def shape(self) -> tuple[int, int]:
        """(M, N): camera pixels, projector pixels."""
        shape: Any = self.matrices[0].shape
        return shape

    @property
    def dense(self) -> bool:
        """Whether the matrices are plain arrays."""
        return isinstance(self.matrices[0], np.ndarray)

    @property
    def stored(self) -> bool:
        """Whether the matrices are in a store, and not in memory."""
        return isinstance(self.matrices[0], StoredRows)

    @property
    def bounces_from_diagonal(self) -> bool:
        """Whether a first bounce taken from the diagonal of T, the default on loading, would be the same."""
        if self.first_bounce is None or self.shape[0] != self.shape[1]:
            return True
        diagonals = np.stack([T.diagonal() for T in self.matrices])
        return np.allclose(self.first_bounce, diagonals, rtol=1e-6, atol=0)

    def in_memory(self) -> Record:
        """The same, of a store's blocks all loaded."""
        matrices = tuple(T.tocsr() if isinstance(T, StoredRows) else T for T in self.matrices)
        return replace(self, matrices=matrices)


def choose(
    shapes: Mapping[str, tuple[int, ...]], variable: str | None, name: str, channels: Sequence[str] = ()
) -> tuple[str, ...]:
    """Names of what holds T: `variable`, else `name`, else three `channels`, else the only matrix."""
    if variable is not None or name in shapes:
        return (variable or name,)
    if channels and all(channel in shapes for channel in channels):
        return tuple(channels)
    others = {other: shape for other, shape in shapes.items() if other not in EXTRAS}
    names = tuple(other for other, shape in others.items() if headers.is_matrix_shape(shape))
    if len(names) != 1:
        listed = ", ".join(f"{other!r} {shape}" for other, shape in others.items()) or "no array of numbers"
        raise FileError(
            f"holds {listed:.300}; it must hold {name} of (M, N) or with three channels, or one matrix by "
            "another name; variable= names one of several"
        )
    return names


def from_arrays(matrices: Sequence[Any], extras: Mapping[str, np.ndarray]) -> Record:
    """A record of matrices, or of one array (k, M, N), and the small arrays that stand with them."""
    small: dict[str, Any] = {}
    for name, array in extras.items():
        if name not in EXTRAS[:2]:
            small[name] = headers.floats(name, array)
        elif array.size != 2:
            raise FileError(f"array {name!r} has shape {array.shape}; it must be (h, w)")
        else:
            small[name] = checks.grid(f"array {name!r}", array.ravel().tolist())
    if isinstance(matrices[0], np.ndarray):
        for T in matrices:
            headers.matrix_shape("T", T.shape)
        matrices = [headers.floats("T", T) for T in matrices]
        matrices = list(matrices[0]) if matrices[0].ndim == 3 else matrices
    return Record(tuple(matrices), **small)


@dataclass(frozen=True, eq=False)
class Parts:
    """Arrays of a compressed transport, or of an inverse, by the names of `ltcl.transport`.

    They are finite, with a grid and a first bounce that fit (else InputError); what they make is checked
    where it is made.
    """

    arrays: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        for name in ("grid", "first_bounce", "system_0.R.kind"):
            if name not in self.arrays:
                raise InputError(f"a compressed transport has the array {name!r}, which is missing")
        F = self.arrays["first_bounce"]
        if F.ndim != 2 or len(F) not in (1, 3):
            raise InputError(f"first_bounce has shape {F.shape}; it must be (1, N) or (3, N)")
        checks.shape("grid", self.arrays["grid"], (2,))
        checks.grid("grid", self.arrays["grid"].tolist(), F.shape[1])
        for name, array in self.arrays.items():
            if array.dtype.kind == "f" and not name.endswith(_MAY_BE_INFINITE):
                checks.finite(f"array {name!r}", array)
        if "mixing" in self.arrays:
            layout.mixing(self.arrays["mixing"], len(F), None)

    @property
    def shape(self) -> tuple[int, int]:
        """(N, N)."""
        n = self.first_bounce.shape[1]
        return n, n

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of projector and camera."""
        h, w = self.arrays["grid"].tolist()
        return h, w

    camera_grid = None

    @property
    def first_bounce(self) -> np.ndarray:
        """F, (channels, N)."""
        return self.arrays["first_bounce"]

    @property
    def mixing(self) -> np.ndarray | None:
        """Of the projector's colours, (3, 3)."""
        return self.arrays.get("mixing")

    @property
    def error(self) -> float:
        """Bound on the relative error of solutions, the largest of all channels."""
        errors = [array for name, array in self.arrays.items() if name.endswith((_MAY_BE_INFINITE, "errors"))]
        numbers = [array for array in errors if array.dtype.kind in "fiu"]
        return max((float(np.max(array, initial=0.0)) for array in numbers), default=0.0)

    @property
    def nbytes(self) -> int:
        """Bytes of the operators, as they are stored."""
        return sum(a.nbytes for name, a in self.arrays.items() if name.startswith(("system_", "basis_")))

    @property
    def entries(self) -> int:
        """Values that are not 0, of all cores."""
        ends = (".data", ".codes", ".matrix")
        return sum(int(np.count_nonzero(array)) for name, array in self.arrays.items() if name.endswith(ends))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the cores and bases, each once."""
        texts = [(name, str(array)) for name, array in self.arrays.items() if array.dtype.kind in "SU"]
        cores = {text for name, text in texts if name.endswith(".kind")} - {"compressed", "sum"}
        return (*sorted(cores), *sorted({text for name, text in texts if name.startswith("basis_")}))
