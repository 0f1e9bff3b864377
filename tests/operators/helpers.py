# SPDX-License-Identifier: BSD-3-Clause
"""What the tests of every operator share."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg

from ltcl.device import Array, Device
from ltcl.operators import CSR, Dense, Operator, Tiles
from ltcl.operators.rows import RowOperator, Variant
from tests import gallery, reference

COLUMNS = (None, 1, 2, 3, 5, 6, 8, 11)  # None: (N,), not (N, 1)
# scale, what is added and how often, shift (of square operators)
EPILOGUES = {
    "plain": (1.0, None, 1.0, 0.0),
    "scaled": (-0.75, None, 1.0, 0.0),
    "added": (0.5, "other", 1.0, 0.0),
    "onto itself": (-1.0, "out", 1.0, 0.0),
    "all": (0.5, "other", -2.0, 0.75),
    "all onto itself": (-1.0, "out", 0.5, 1.0),
}
# Formats of rows, of an array or a sparse matrix.
FORMATS: dict[str, Any] = {
    "csr": lambda device, matrix: CSR(device, scipy.sparse.csr_array(matrix)),
    "dense": lambda device, matrix: Dense(device, scipy.sparse.coo_array(matrix).toarray()),
    "tiles of 1": lambda device, matrix: Tiles(device, matrix, 1, "float16"),
    "tiles of 8": lambda device, matrix: Tiles(device, matrix, 8, "float32"),
    "bytes": lambda device, matrix: Tiles(device, matrix, 8, "int8"),
}
ROWS = ("csr", "dense")  # those that relaxation and walks can read
# How a product may be launched on CPUs and GPUs.
LAUNCHES = {"item": Variant("", 16, shared=False)} | {
    # Fewer items than columns and more, neither a power of two: sums in trees work for any size.
    f"group{items}": Variant("_group", items, shared=True)
    for items in (7, 100)
}


def meets_twin(A: Operator, matrix: np.ndarray, *, transpose: bool = False) -> None:
    """Assert that products of A, or of A^T, are those of `matrix` to rounding.

    For every number of right-hand sides and every epilogue, into an array of NaN where nothing is
    added.
    """
    matrix = matrix.T if transpose else matrix
    rows, columns = matrix.shape
    apply = A.apply_transpose if transpose else A.apply
    for k in COLUMNS:
        x, y = gallery.vectors(columns, k), gallery.vectors(rows, k, 2)
        for scale, kind, add_scale, shift in EPILOGUES.values():
            add, out = operands(A, y, kind)
            y_term = add_scale * y.astype(np.float64) if kind else 0.0 * y
            x_term = shift * x.astype(np.float64) if rows == columns else 0.0 * y
            numbers = {
                "scale": scale,
                "add_scale": add_scale,
                "shift": shift if rows == columns else 0.0,
            }
            assert apply(A.device.upload(x), out, add=add, **numbers) is out
            error = reference.product_error(matrix, x, scale, np.abs(y_term) + np.abs(x_term))
            close(out.get(), reference.dense_matvec(matrix, x, scale, y_term + x_term), error)


def norms_match(A: Operator, matrix: np.ndarray, rtol: float = 1e-12) -> None:
    """Assert that the norms of A are those of `matrix`, float64."""
    norms = A.norms()
    expected = [np.linalg.norm(matrix, order) for order in (1, np.inf, "fro")]
    assert [norms.one, norms.inf, norms.frobenius] == pytest.approx(expected, rel=rtol)
    assert norms.lowest == min(matrix.min(initial=0.0), 0.0)


def operands(A: Operator, values: np.ndarray, kind: str | None) -> tuple[Array | None, Array]:
    if kind == "out":
        out = A.device.upload(values)
        return out, out
    garbage = A.device.upload(np.full_like(values, np.nan))
    return (A.device.upload(values) if kind else None), garbage


def product(A: Operator, x: np.ndarray) -> np.ndarray:
    """A x, of the type that `@` does not tell."""
    return A.apply(A.device.upload(x)).get()


def close(found: np.ndarray, expected: np.ndarray, error: np.ndarray) -> None:
    """Assert |found - expected| <= error, value by value."""
    assert found.shape == expected.shape
    np.testing.assert_array_less(np.abs(found - expected), error + np.finfo(np.float32).tiny)


def refused(error: Any, *cases: tuple[Any, ...]) -> None:
    """Assert that each call of (part, call, *arguments) raises the error, with that part in its message."""
    for part, call, *arguments in cases:
        with pytest.raises(error, match=part):
            call(*arguments)


def same_bits(a: np.ndarray, b: np.ndarray) -> None:
    assert a.dtype == b.dtype
    np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32))


def same_rows(device: Device, a: np.ndarray, b: np.ndarray, error: np.ndarray) -> None:
    """Assert that rows do not depend on the slab they are in: to the bit, where the driver allows that.

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
    """Let A run all its products as `name` says; small operators take the first variant unasked."""
    monkeypatch.setattr(A, "variants", lambda: {name: LAUNCHES[name]})


def steps_match(S: Operator, matrix: np.ndarray, columns: tuple[int | None, ...] = COLUMNS) -> None:
    """Assert that steps of S are those of `matrix` in float64 to rounding, norms of residuals included."""
    n = len(matrix)
    for k in columns:
        x, r = (
            gallery.vectors(n, k, 7).astype(np.float64),
            gallery.vectors(n, k, 8).astype(np.float64),
        )
        on_device = S.device.upload(x), S.device.upload(r)
        stepper = S.stepper(*on_device)
        stepper.start(0.5)
        d, norms = 0.5 * r, []
        for keep, gain in ((0.0, 1.0), (0.25, 0.5), (-0.5, 0.75)):
            stepper.step(keep, gain)
            x, r = x + d, r - matrix @ d
            d = keep * d + gain * r
            norms.append(np.atleast_1d(np.linalg.norm(r, axis=0)))
        assert stepper.waiting == 3
        scale = (
            1e-5
            * (1.0 + np.abs(matrix).sum(axis=1).max()) ** 3
            * (1.0 + np.abs(gallery.vectors(n, k)).max())
        )
        for array, expected in zip((*on_device, stepper.d), (x, r, d), strict=True):
            np.testing.assert_allclose(array.get(), expected, atol=scale)
        np.testing.assert_allclose(stepper.norms(), norms, rtol=1e-4, atol=scale)
        assert stepper.waiting == 0
