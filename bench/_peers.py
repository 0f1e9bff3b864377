# SPDX-License-Identifier: BSD-3-Clause
"""Sparse products of others, in float32 with 32-bit indices: what the extra `bench` brings, and CuPy.

A peer that is not installed is named and left out; SciPy and NumPy are always there.
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
    """A @ x by every peer that is there, for a csr_array A of float32 and x (N,) or (N, k)."""
    makers = {"sparse_dot_mkl": _mkl, "cupy": _cupy}
    absent = missing()
    products = {name: make(A, x) for name, make in makers.items() if name not in absent}
    return {"scipy": lambda: A @ x, **products}


def _mkl(A: Any, x: np.ndarray) -> Product:
    import scipy.sparse

    os.environ.setdefault("KMP_BLOCKTIME", "0")  # its threads must not spin while others are timed
    # It looks for the library beside Python itself, where an environment of `venv` has it not.
    found = [file for file in metadata.files("mkl") or () if file.name.startswith("libmkl_rt")]
    if found:
        os.environ.setdefault("MKL_RT", str(found[0].locate()))
    mkl: Any = importlib.import_module("sparse_dot_mkl")

    matrix = scipy.sparse.csr_matrix(A)  # it takes no csr_array
    return lambda: mkl.dot_product_mkl(matrix, x)


def _cupy(A: Any, x: np.ndarray) -> Product:
    cupy: Any = importlib.import_module("cupy")  # in no extra: it needs CUDA
    sparse: Any = importlib.import_module("cupyx.scipy.sparse")

    parts = (cupy.asarray(A.data), cupy.asarray(A.indices), cupy.asarray(A.indptr))
    matrix, operand = sparse.csr_matrix(parts, shape=A.shape), cupy.asarray(x, order="F")

    def run() -> np.ndarray:
        product = matrix @ operand  # cuSPARSE, on the device as ours is
        cupy.cuda.Device().synchronize()
        return product

    return run
