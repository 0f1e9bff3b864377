# SPDX-License-Identifier: BSD-3-Clause
"""Sparse products of other libraries, in float32 with 32-bit indices.

The extra `bench` installs them, except CuPy. A peer that is not installed is named and left out;
SciPy and NumPy are always present.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable
from importlib import metadata
from typing import Any

import numpy as np

Product = Callable[[], np.ndarray]
PEERS = ("scipy", "numba", "sparse_dot_mkl", "cupy")


def missing() -> list[str]:
    """Peers that are not installed."""
    return [name for name in PEERS if importlib.util.find_spec(name) is None]


def sparse_products(A: Any, x: np.ndarray) -> dict[str, Product]:
    """A @ x by every installed peer, for a csr_array A of float32 and x (N,) or (N, k)."""
    products: dict[str, Product] = {"scipy": lambda: A @ x}
    absent = missing()
    if "sparse_dot_mkl" not in absent:
        products["sparse_dot_mkl"] = _mkl(A, x)
    if "cupy" not in absent:
        products["cupy"] = _cupy(A, x)
    return products


def _mkl(A: Any, x: np.ndarray) -> Product:
    import scipy.sparse

    # Its threads must not spin while other products are timed.
    os.environ.setdefault("KMP_BLOCKTIME", "0")
    library = _mkl_library()
    if library is not None:
        os.environ.setdefault("MKL_RT", library)
    mkl: Any = importlib.import_module("sparse_dot_mkl")

    # MKL's wrapper accepts a csr_matrix only.
    matrix = scipy.sparse.csr_matrix(A)
    return lambda: mkl.dot_product_mkl(matrix, x)


def _mkl_library() -> str | None:
    """Path of the library: the wrapper looks beside Python, where a venv does not have it."""
    files = metadata.files("mkl")
    if files is None:
        return None
    for file in files:
        if file.name.startswith("libmkl_rt"):
            return str(file.locate())
    return None


def _cupy(A: Any, x: np.ndarray) -> Product:
    # CuPy is in no extra, as it needs CUDA.
    cupy: Any = importlib.import_module("cupy")
    sparse: Any = importlib.import_module("cupyx.scipy.sparse")

    arrays = (cupy.asarray(A.data), cupy.asarray(A.indices), cupy.asarray(A.indptr))
    matrix = sparse.csr_matrix(arrays, shape=A.shape)
    operand = cupy.asarray(x, order="F")

    def run() -> np.ndarray:
        # cuSPARSE, on the device as ours is.
        result = matrix @ operand
        cupy.cuda.Device().synchronize()
        return result

    return run
