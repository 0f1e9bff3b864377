# SPDX-License-Identifier: BSD-3-Clause
"""Matrices, launches and assertions that the tests of every operator share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg

from ltcl.device import Array, Device
from ltcl.operators import CSR, Dense, Operator, Tiles
from ltcl.operators.rows import RowOperator, Variant
from tests import gallery, reference

# Numbers of right-hand sides; None for (N,), not (N, 1).
COLUMNS = (None, 1, 2, 3, 5, 6, 8, 11)


@dataclass(frozen=True)
class Terms:
    """The terms of a product: scale (A x) + add_scale `added` + shift x, if A is square.

    `added` is another array, "out" itself, or None.
    """

    scale: float
    added: str | None = None
    add_scale: float = 1.0
    shift: float = 0.0


EPILOGUES = {
    "plain": Terms(1.0),
    "scaled": Terms(-0.75),
    "added": Terms(0.5, "other"),
    "onto itself": Terms(-1.0, "out"),
    "all": Terms(0.5, "other", -2.0, 0.75),
    "all onto itself": Terms(-1.0, "out", 0.5, 1.0),
}


def csr(device: Device, matrix: Any) -> CSR:
    return CSR(device, scipy.sparse.csr_array(matrix))


def dense(device: Device, matrix: Any) -> Dense:
    return Dense(device, scipy.sparse.coo_array(matrix).toarray())


def tiles_of_1(device: Device, matrix: Any) -> Tiles:
    return Tiles(device, matrix, 1, "float16")


def tiles_of_8(device: Device, matrix: Any) -> Tiles:
    return Tiles(device, matrix, 8, "float32")


def tiles_of_bytes(device: Device, matrix: Any) -> Tiles:
    return Tiles(device, matrix, 8, "int8")


# Formats of rows, from an array or a sparse matrix.
FORMATS: dict[str, Callable[[Device, Any], Any]] = {
    "csr": csr,
    "dense": dense,
    "tiles of 1": tiles_of_1,
    "tiles of 8": tiles_of_8,
    "bytes": tiles_of_bytes,
}
# The formats that relaxation and walks can read.
ROWS = ("csr", "dense")
# Launches of a product as on CPUs and GPUs: fewer items than columns and more, neither a power of
# two, since sums in trees work for any size.
LAUNCHES = {
    "item": Variant("", 16, shared=False),
    "group7": Variant("_group", 7, shared=True),
    "group100": Variant("_group", 100, shared=True),
}


def meets_twin(A: Operator, matrix: np.ndarray, *, transpose: bool = False) -> None:
    """Assert that products of A, or of A^T, are those of `matrix` to rounding.

    Every number of right-hand sides and every epilogue is tried, into an array of NaN if nothing is
    added to it.
    """
    if transpose:
        matrix = matrix.T
    for k in COLUMNS:
        for terms in EPILOGUES.values():
            check_product(A, matrix, k, terms, transpose=transpose)


def check_product(
    A: Operator, matrix: np.ndarray, k: int | None, terms: Terms, *, transpose: bool = False
) -> None:
    """Assert that one product of A, or of A^T, is that of `matrix`."""
    rows, columns = matrix.shape
    is_square = rows == columns
    shift = terms.shift if is_square else 0.0
    x = gallery.vectors(columns, k)
    y = gallery.vectors(rows, k, 2)
    y_term = np.zeros(y.shape)
    if terms.added is not None:
        y_term = terms.add_scale * y.astype(np.float64)
    x_term = np.zeros(y.shape)
    if is_square:
        x_term = shift * x.astype(np.float64)

    added, out = operands(A, y, terms.added)
    apply = A.apply_transpose if transpose else A.apply
    result = apply(
        A.device.upload(x),
        out,
        add=added,
        scale=terms.scale,
        add_scale=terms.add_scale,
        shift=shift,
    )
    assert result is out
    error = reference.product_error(matrix, x, terms.scale, np.abs(y_term) + np.abs(x_term))
    expected = reference.dense_matvec(matrix, x, terms.scale, y_term + x_term)
    close(out.get(), expected, error)


def operands(A: Operator, values: np.ndarray, added: str | None) -> tuple[Array | None, Array]:
    """The array that is added to a product, and the one it is written to."""
    if added == "out":
        out = A.device.upload(values)
        return out, out
    garbage = A.device.upload(np.full_like(values, np.nan))
    if added is None:
        return None, garbage
    return A.device.upload(values), garbage


def norms_match(A: Operator, matrix: np.ndarray, rtol: float = 1e-12) -> None:
    """Assert that the norms of A are those of `matrix`, float64."""
    norms = A.norms()
    expected = [np.linalg.norm(matrix, order) for order in (1, np.inf, "fro")]
    assert [norms.one, norms.inf, norms.frobenius] == pytest.approx(expected, rel=rtol)
    assert norms.lowest == min(matrix.min(initial=0.0), 0.0)


def product(A: Operator, x: np.ndarray) -> np.ndarray:
    """A x as float32, whatever type `@` would give."""
    return A.apply(A.device.upload(x)).get()


def close(found: np.ndarray, expected: np.ndarray, error: np.ndarray) -> None:
    """Assert |found - expected| <= error, value by value."""
    assert found.shape == expected.shape
    np.testing.assert_array_less(np.abs(found - expected), error + np.finfo(np.float32).tiny)


def refused(error: Any, *cases: tuple[Any, ...]) -> None:
    """Assert that each (part, call, *arguments) raises the error with that part in its message."""
    for part, call, *arguments in cases:
        with pytest.raises(error, match=part):
            call(*arguments)


def same_bits(a: np.ndarray, b: np.ndarray) -> None:
    assert a.dtype == b.dtype
    np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32))


def same_rows(device: Device, a: np.ndarray, b: np.ndarray, error: np.ndarray) -> None:
    """Assert that rows do not depend on their slab: to the bit, if the driver allows that.

    Intel's compiler works on several rows at once, and contracts a * b + c to another rounding in
    those that are left over at the end of a slab.
    """
    if "Intel" in device.driver:
        close(a, b, 2 * error)
    else:
        same_bits(a, b)


class Plain(scipy.sparse.linalg.LinearOperator):
    """A user's own operator that knows no transpose."""

    def __init__(self, matrix: Any) -> None:
        super().__init__(matrix.dtype, matrix.shape)
        self.matrix = matrix

    def _matvec(self, x):
        return self.matrix @ x


def force(monkeypatch: pytest.MonkeyPatch, A: RowOperator, name: str) -> None:
    """Let A run all its products as `name` says; a single variant is not timed."""
    monkeypatch.setattr(A, "variants", lambda: {name: LAUNCHES[name]})


def steps_match(S: Operator, matrix: np.ndarray, columns: tuple[int | None, ...] = COLUMNS) -> None:
    """Assert that steps of S, and norms of residuals, are those of `matrix` in float64."""
    for k in columns:
        _check_steps(S, matrix, k)


def _check_steps(S: Operator, matrix: np.ndarray, k: int | None) -> None:
    n = len(matrix)
    x = gallery.vectors(n, k, 7).astype(np.float64)
    r = gallery.vectors(n, k, 8).astype(np.float64)
    x_on_device = S.device.upload(x)
    r_on_device = S.device.upload(r)
    stepper = S.stepper(x_on_device, r_on_device)
    stepper.start(0.5)
    d = 0.5 * r
    norms = []
    for keep, gain in ((0.0, 1.0), (0.25, 0.5), (-0.5, 0.75)):
        stepper.step(keep, gain)
        x = x + d
        r = r - matrix @ d
        d = keep * d + gain * r
        norms.append(np.atleast_1d(np.linalg.norm(r, axis=0)))
    assert stepper.waiting == 3
    growth = 1.0 + np.abs(matrix).sum(axis=1).max()
    largest = 1.0 + np.abs(gallery.vectors(n, k)).max()
    error = 1e-5 * growth**3 * largest
    np.testing.assert_allclose(x_on_device.get(), x, atol=error)
    np.testing.assert_allclose(r_on_device.get(), r, atol=error)
    np.testing.assert_allclose(stepper.d.get(), d, atol=error)
    np.testing.assert_allclose(stepper.norms(), norms, rtol=1e-4, atol=error)
    assert stepper.waiting == 0
