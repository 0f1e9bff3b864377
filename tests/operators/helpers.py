# SPDX-License-Identifier: BSD-3-Clause
"""What the tests of every operator share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ltcl.device import Array, Device
from ltcl.operators import Operator
from ltcl.operators.rows import Launch, RowOperator
from tests import gallery, reference

COLUMNS = (None, 1, 2, 3, 5, 6, 8, 11)  # None: (N,), not (N, 1)
EPILOGUES = {
    "plain": (1.0, None),
    "scaled": (-0.75, None),
    "added": (0.5, "other"),
    "onto itself": (-1.0, "out"),
}
# How a product may be launched: end of the kernel's name and items that share a row.
LAUNCHES = {"item": ("", 0), "stream": ("_stream", 0)} | {
    f"group{items}": ("_group", items)
    for items in (7, 32, 64, 128)  # sums in trees work for any size
}
Twin = Callable[..., np.ndarray]


def meets_twin(A: Operator, matrix: np.ndarray, twin: Twin | None = None, *, transpose: bool = False) -> None:
    """Assert that products of A, or of A^T, are those of `matrix` to rounding.

    For every number of right-hand sides and every epilogue, into an array of NaN where nothing is added.
    """
    matrix = matrix.T if transpose else matrix
    twin = twin or (lambda *arguments: reference.dense_matvec(matrix, *arguments))
    apply = A.apply_transpose if transpose else A.apply
    for k in COLUMNS:
        x = gallery.vectors(matrix.shape[1], k)
        for scale, kind in EPILOGUES.values():
            add, out = operands(A, gallery.vectors(matrix.shape[0], k, 2), kind)
            expected_add = None if add is None else add.get()
            assert apply(A.device.upload(x), out, scale=scale, add=add) is out
            expected = twin(x, scale, expected_add)
            close(out.get(), expected, reference.product_error(matrix, x, scale, expected_add))


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


def same_bits(a: np.ndarray, b: np.ndarray) -> None:
    assert a.dtype == b.dtype
    np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32))


def same_rows(device: Device, a: np.ndarray, b: np.ndarray, error: np.ndarray) -> None:
    """Assert that rows do not depend on the slab they are in: to the bit, where the driver allows that.

    Intel's compiler works on several rows at once, and contracts a * b + c to another rounding in those
    that are left over at the end of a slab.
    """
    if "Intel" in device.driver:
        close(a, b, 2 * error)
    else:
        same_bits(a, b)


def norms_match(A: Operator, matrix: np.ndarray, rel: float) -> None:
    norms = A.norms()
    assert norms.one == pytest.approx(np.linalg.norm(matrix, 1), rel=rel)
    assert norms.inf == pytest.approx(np.linalg.norm(matrix, np.inf), rel=rel)
    assert norms.frobenius == pytest.approx(np.linalg.norm(matrix, "fro"), rel=rel)
    assert norms.lowest == pytest.approx(min(float(matrix.min(initial=0.0)), 0.0), rel=rel)


def force(monkeypatch: pytest.MonkeyPatch, A: RowOperator, name: str) -> None:
    """Let A run all its products as `name` says; small operators take the first variant unasked."""
    suffix, group = LAUNCHES[name]

    def variants(width: int, columns: int) -> dict[str, Launch]:
        return {name: Launch(A.kernel(f"{A.file}_matvec{suffix}", width, columns), group)}

    monkeypatch.setattr(A, "variants", variants)
