# SPDX-License-Identifier: BSD-3-Clause
"""Plain arrays of a compressed transport T = S diag(d), for files and pickles.

grid             (2,)                  height and width
first_bounce     (channels, N)         F
columns_c        (N,)                  d of channel c, where it differs from F
mixing           (3, 3)                optional
noise_...                              as `Noise.to_arrays` has them, optional
all others                             S of each channel, see `ltcl.operators.stored`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import ScaledColumns
from ltcl.operators import stored as stored_operators
from ltcl.operators.interreflection import underlying_system
from ltcl.operators.pyramid import PYRAMID

if TYPE_CHECKING:
    from ltcl.transport.transport import Transport


def to_arrays(T: Transport) -> dict[str, np.ndarray]:
    """The arrays of a compressed T, S diag(d) in each channel."""
    systems = []
    for matrix in T.matrices:
        S = underlying_system(matrix)
        if S is not None:
            systems.append(S)
    if not T.is_square or len(systems) < T.channels:
        kinds = {type(matrix).__name__ for matrix in T.matrices}
        names = ", ".join(sorted(kinds))
        raise InputTypeError(
            f"T is made of {names}; only arrays, sparse matrices and S diag(F) are stored"
        )
    F = np.atleast_2d(T.first_bounce)
    arrays = {"grid": np.array(T.grid), "first_bounce": F}
    if T.mixing is not None:
        arrays["mixing"] = T.mixing
    if T.measured_noise is not None:
        arrays |= T.measured_noise.to_arrays()
    for channel, (matrix, f) in enumerate(zip(T.matrices, F, strict=True)):
        if not np.array_equal(matrix.d, f):
            arrays[f"columns_{channel}"] = np.asarray(matrix.d, np.float64)
    return arrays | stored_operators.to_arrays(systems)


def arrays_of_scan(
    grid: tuple[int, int],
    cores: Sequence[scipy.sparse.csr_array],
    diagonals: np.ndarray,
    first_bounce: np.ndarray,
    mixing: np.ndarray | None = None,
    sums: str = PYRAMID,
    scales: np.ndarray | None = None,
) -> dict[str, np.ndarray]:
    """The arrays of T = I + C W of each channel, C (N, sums) between pixels and the sums W.

    With `scales`, (channels, N), of T = I + diag(scale) W^T C W, C (sums, sums). `diagonals` are
    those of T - I, (channels, N); `first_bounce` is like them. `sums` is the name of W: "pyramid"
    or "hats".
    """
    arrays = {"grid": np.array(grid), "first_bounce": first_bounce}
    if mixing is not None:
        arrays["mixing"] = np.asarray(mixing)
    for channel in range(len(cores)):
        arrays[f"columns_{channel}"] = np.ones(diagonals.shape[1])
    return arrays | stored_operators.multiscale_arrays(sums, grid, cores, diagonals, scales)


def matrices_from_arrays(
    arrays: Mapping[str, np.ndarray], device: Device
) -> tuple[ScaledColumns, ...]:
    """S diag(d) of each channel, uploaded."""
    F = arrays["first_bounce"]
    systems = stored_operators.from_arrays(device, arrays)
    if len(systems) != len(F):
        raise InputError(
            f"first_bounce has {len(F)} channels, but there are {len(systems)} operators"
        )
    matrices = []
    for channel, S in enumerate(systems):
        d = arrays.get(f"columns_{channel}", F[channel])
        matrices.append(ScaledColumns(S, d))
    return tuple(matrices)
