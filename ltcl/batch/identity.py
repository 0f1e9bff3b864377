# SPDX-License-Identifier: BSD-3-Clause
"""By what a transport and the settings of a run are known again."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.transport import Transport

_PROBES = 4
_CLOSE = 1e-5  # of products in float32, whose order of summation may change
_FEW = 8  # numbers are shown as they are, more by a digest


def of_transport(T: Transport) -> dict[str, Any]:
    """Sizes and a SHA-256 of all entries; of operators without entries, some numbers u.(T v) instead.

    Not of the first bounce: compensation does not depend on it. The error of a compressed T may; it is told,
    not compared.
    """
    matrices = T.matrices if T.blocks is None else tuple(part for row in T.blocks for part in row)
    digest, probes = hashlib.sha256(), []
    for matrix in matrices:
        parts = _entries(matrix)
        probes += _probes(matrix) if parts is None else []
        for part in parts or ():
            _add(digest, part)
    _add(digest, T.masked)
    if T.mixing is not None:
        _add(digest, T.mixing)
    return {
        "shape": list(T.shape),
        "channels": T.channels,
        "grid": list(T.grid),
        "camera_grid": list(T.camera_grid),
        "error": T.error,
        "digest": digest.hexdigest(),
        "probes": probes,
    }


def same_transport(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two of these are of the same T."""
    told = ("probes", "error")
    exact = [{key: value for key, value in part.items() if key not in told} for part in (one, other)]
    probes = [part.get("probes", []) for part in (one, other)]
    return (
        exact[0] == exact[1]
        and len(probes[0]) == len(probes[1])
        and np.allclose(*probes, rtol=_CLOSE, atol=0)
    )


def of_setting(value: Any) -> Any:
    """A setting in the types of JSON: pictures by a digest, objects by what they say of themselves.

    >>> of_setting((0.0, 1.0)), of_setting("auto"), of_setting(np.zeros((4, 5)))[:13]
    ([0.0, 1.0], 'auto', '4 x 5, sha256')
    """
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        text = repr(value)
        return type(value).__name__ if " at 0x" in text else text  # an address is of one run
    if array.size <= _FEW:
        return array.tolist()
    digest = hashlib.sha256()
    _add(digest, array.astype(np.float64))
    return f"{' x '.join(map(str, array.shape))}, sha256 {digest.hexdigest()}"


def _entries(matrix: Any) -> tuple[np.ndarray, ...] | None:
    if isinstance(matrix, scipy.sparse.csr_array):
        return matrix.data, matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64)
    return (matrix,) if isinstance(matrix, np.ndarray) else None


def _probes(matrix: Any) -> list[float]:
    rng = np.random.default_rng(0)
    rows, columns = matrix.shape
    return [float(rng.random(rows) @ (matrix @ rng.random(columns))) for _ in range(_PROBES)]


def _add(digest: Any, array: np.ndarray) -> None:
    digest.update(f"{array.dtype} {array.shape};".encode())
    digest.update(np.ascontiguousarray(array))
