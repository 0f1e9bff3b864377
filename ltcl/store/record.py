# SPDX-License-Identifier: BSD-3-Clause
"""A transport as files hold it: plain host arrays and what little is known besides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from ltcl import checks, layout
from ltcl.errors import InputError, InputTypeError
from ltcl.store.blocks import StoredRows

Matrix = np.ndarray | scipy.sparse.csr_array | StoredRows
_KINDS = (np.ndarray, scipy.sparse.csr_array, StoredRows)


@dataclass(frozen=True)
class Record:
    """Contents of a transport file, `picture = T @ pattern`.

    Attributes
    ----------
    matrices
        One matrix, or three for red, green and blue, each (M, N): M camera pixels, N projector pixels, both
        row-major. All dense, all `csr_array` or all `StoredRows`, real.
    grid
        (h, w) of the projector, or None where the file does not tell.
    camera_grid
        (h, w) of the camera; None where it is not told, or the camera is on the projector's grid.
    first_bounce
        Direct light per pixel, (N,) or (3, N), or None.
    mixing
        Of the projector's colours, (3, 3), for three matrices, or None.

    Raises
    ------
    InputError, InputTypeError
        The parts do not fit each other.

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
        kinds = {next((kind for kind in _KINDS if isinstance(T, kind)), None) for T in self.matrices}
        if None in kinds or len(kinds) > 1:
            names = ", ".join(type(T).__name__ for T in self.matrices)
            raise InputTypeError(f"matrices are {names}; they must be all arrays or all csr_array")
        shapes = {_shape(T) for T in self.matrices}
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
        rows, columns = _shape(self.matrices[0])
        return rows, columns

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


def _shape(T: Matrix) -> tuple[int, ...]:
    return tuple(T.shape or ())
