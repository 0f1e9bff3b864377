# SPDX-License-Identifier: BSD-3-Clause
"""A compressed transport as plain arrays by name, and made of such again; files hold these.

Beside what `ltcl.operators.stored` names there are grid (2,), first_bounce (channels, N), mixing (3, 3) where
colours mix, and columns_0, ... (N,) of channels whose T is S diag(d) with another d than the first bounce.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import ScaledColumns, stored
from ltcl.operators.interreflection import made_with
from ltcl.transport import Transport


def of(T: Transport) -> dict[str, np.ndarray]:
    """The arrays of a T whose every channel is S diag(d).

    Raises
    ------
    InputTypeError
        T is made of something else.
    """
    systems = [made_with(matrix) for matrix in T.matrices]
    known = [S for S in systems if S is not None]
    if not T.is_square or len(known) < len(systems):
        kinds = ", ".join(sorted({type(matrix).__name__ for matrix in T.matrices}))
        raise InputTypeError(
            f"T is made of {kinds}; only arrays, sparse matrices and operators S diag(F) can be saved"
        )
    F = np.atleast_2d(T.first_bounce)
    arrays = {"grid": np.array(T.grid), "first_bounce": F}
    if T.mixing is not None:
        arrays["mixing"] = T.mixing
    for channel, (matrix, f) in enumerate(zip(T.matrices, F, strict=True)):
        if not np.array_equal(matrix.d, f):
            arrays[f"columns_{channel}"] = np.asarray(matrix.d, np.float64)
    return arrays | stored.to_arrays(known)


def assemble(
    arrays: Mapping[str, np.ndarray],
    *,
    grid: Any = None,
    first_bounce: Any = None,
    on_dark: str = "raise",
    device: Device | str | None = None,
) -> Transport:
    """The transport of such arrays, on a device that is opened at once.

    Parameters
    ----------
    grid : (h, w), optional
        Has to be that of the arrays.
    first_bounce, on_dark, device
        As in `Transport`; the first bounce of the arrays when not given.

    Raises
    ------
    InputError
        Arrays that are missing, or do not fit each other.

    Examples
    --------
    >>> from ltcl.operators import Dense, IdentityPlus
    >>> S = IdentityPlus(Dense(open_device(), [[0.0, 0.5], [0.5, 0.0]]))
    >>> T = Transport(ScaledColumns(S, np.array([0.5, 0.25])), grid=(1, 2), first_bounce=[0.5, 0.25])
    >>> print(assemble(of(T)) @ np.array([[1.0, 1.0]]))
    [[0.625 0.5  ]]
    """
    F, own = arrays["first_bounce"], checks.grid("grid", arrays["grid"].tolist())
    if grid is not None and checks.grid("grid", grid) != own:
        raise InputError(f"grid is {grid!r}; this transport is compressed on its own, {own}")
    systems = stored.from_arrays(open_device(device), arrays)
    if len(systems) != len(F):
        raise InputError(f"first_bounce has {len(F)} channels, but there are {len(systems)} operators")
    columns = [arrays.get(f"columns_{channel}", f) for channel, f in enumerate(F)]
    matrices = [ScaledColumns(S, d) for S, d in zip(systems, columns, strict=True)]
    return Transport(
        matrices,
        own,
        first_bounce=F if first_bounce is None else first_bounce,
        on_dark=on_dark,
        mixing=arrays.get("mixing"),
    )
