# SPDX-License-Identifier: BSD-3-Clause
"""What the tests of every format share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import LtclError
from ltcl.store import formats
from ltcl.store.record import Matrix, Record


def dense(M: int = 12, N: int = 12, dtype: str = "float32", seed: int = 1) -> np.ndarray:
    """(M, N) with a strong diagonal, as a transport has."""
    T = np.random.default_rng(seed).random((M, N))
    np.fill_diagonal(T, 5 + T.diagonal())
    return T.astype(dtype)


def sparse(N: int = 12, dtype: str = "float32", seed: int = 1, pattern: int = 1) -> scipy.sparse.csr_array:
    """(N, N) csr; equal `pattern` gives equal places, `seed` the values."""
    keep = np.random.default_rng(pattern).random((N, N)) < 0.3
    np.fill_diagonal(keep, True)
    return scipy.sparse.csr_array(np.where(keep, dense(N, N, dtype, seed), 0).astype(dtype))


def same(a: Record, b: Record) -> None:
    """Assert that two records are equal in every value and type."""
    assert (a.grid, a.camera_grid, a.dense) == (b.grid, b.camera_grid, b.dense)
    assert len(a.matrices) == len(b.matrices)
    for x, y in zip(a.matrices, b.matrices, strict=True):
        same_matrix(x, y)
    assert (a.first_bounce is None) == (b.first_bounce is None)
    if a.first_bounce is not None:
        np.testing.assert_array_equal(a.first_bounce, b.first_bounce)
    assert (a.mixing is None) == (b.mixing is None)
    if a.mixing is not None:
        np.testing.assert_array_equal(a.mixing, b.mixing)


def same_matrix(x: Matrix, y: Matrix) -> None:
    assert type(x) is type(y)
    assert x.dtype == y.dtype
    np.testing.assert_array_equal(as_dense(x), as_dense(y))


def as_dense(T: Matrix) -> np.ndarray:
    return T if isinstance(T, np.ndarray) else scipy.sparse.csr_array(T.tocsr()).toarray()


def record_in(path: Path) -> Record:
    """The matrices in a file."""
    record = formats.read(path)
    assert isinstance(record, Record)
    return record


def refusal(path: Path, kind: type[LtclError]) -> str:
    """Text behind the file's name of the error that reading `path` gives; it is one line."""
    with pytest.raises(kind) as error:
        formats.read(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text.removeprefix(f"{path}: ")
