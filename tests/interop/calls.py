# SPDX-License-Identifier: BSD-3-Clause
"""The public calls that take arrays of other libraries, and a small scene for them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import ltcl

GRID = (4, 8)
# Kinds of arrays and operators that a module of these tests covers, as the guide names them.
TABLE = {
    "test_arrays.py": (
        "an array of the array API",
        "an array with DLPack alone",
        "`xarray.DataArray`",
        "Dask array",
        "CuPy array",
    ),
    "test_operators.py": (
        "a `LinearOperator` of SciPy",
        "`LinearOperator` of SciPy 1.18 or newer",
        "PyLops operator",
    ),
    "test_torch.py": ("`torch.Tensor`", "`torch.Tensor` on another device"),
    "test_jax.py": ("`jax.Array`", "JAX's `jit`, `grad`, `vmap`"),
}


@functools.cache
def transport(channels: int = 1) -> Any:
    """A corner of 32 pixels, grey or with three unlike channels."""
    (matrix,) = ltcl.scenes.dihedral(GRID[0]).transport().matrices
    if channels == 1:
        return ltcl.Transport(matrix, GRID)
    return ltcl.Transport([matrix, 0.5 * matrix, 0.7 * matrix], GRID)


def picture(*shape: int, seed: int = 0, high: float = 0.3) -> np.ndarray:
    """Random light in float64, which bounds of 0 and 1 clip in part."""
    return np.random.default_rng(seed).uniform(0.02, high, shape or GRID)


class PublicCall(NamedTuple):
    """A call of one array that returns arrays by name, and the shape of its operand."""

    run: Callable[[Any], dict[str, Any]]
    shape: tuple[int, ...] = GRID


def _compensate(light: Any) -> dict[str, Any]:
    c = ltcl.compensate(transport(), light, background=0.5 * light, weights=light)
    names = ("pattern", "appearance", "target", "out_of_reach")
    return {name: getattr(c, name) for name in names} | {"patterns": c.patterns[0]}


def _separate(light: Any) -> dict[str, Any]:
    b = ltcl.separate(transport(), light, bounces=2)
    return {name: getattr(b, name) for name in ("direct", "indirect", "bounces", "rest")}


def _prepared(frame: Any) -> dict[str, Any]:
    with ltcl.Compensator(transport(), encode="linear", dtype="float32") as compensator:
        return {"codes": compensator(frame), "submitted": compensator.submit(frame).result()}


def _system() -> Any:
    return transport().interreflection


def _products(x: Any) -> dict[str, Any]:
    S = _system()
    return {"b": S.matvec(x), "c": S.rmatvec(x)}


def _matrix_products(X: Any) -> dict[str, Any]:
    S = _system()
    return {"B": S.matmat(X), "C": S.rmatmat(X)}


CALLS = {
    "T @ p": PublicCall(lambda p: {"picture": transport() @ p}),
    "T @ frames": PublicCall(lambda p: {"pictures": transport(3) @ p}, (2, *GRID)),
    "relight": PublicCall(lambda p: {"picture": ltcl.relight(transport(), p)}),
    "compensate": PublicCall(_compensate),
    "separate": PublicCall(_separate),
    "solve": PublicCall(lambda b: {"x": ltcl.solve(_system(), b, "gmres").x}, (32,)),
    "solve from a start": PublicCall(
        lambda b: {"x": ltcl.solve(_system(), b, "gmres", x0=0.5 * b, rtol=1e-4).x}, (32, 2)
    ),
    "Compensator": PublicCall(_prepared),
    "S @ x": PublicCall(lambda x: {"b": _system() @ x}, (32,)),
    "S.matmat": PublicCall(_matrix_products, (32, 3)),
    "S.matvec": PublicCall(_products, (32,)),
}


def gives_back(
    call: PublicCall,
    make: Callable[[np.ndarray], Any],
    kind: type,
    read: Callable[[Any], np.ndarray] = np.asarray,
) -> None:
    """The results for an array of another kind are of that kind, and those of NumPy's array."""
    light = picture(*call.shape)
    expected = call.run(light)
    results = call.run(make(light))
    assert results.keys() == expected.keys()
    for name, value in results.items():
        assert isinstance(value, kind), name
        np.testing.assert_allclose(read(value), expected[name], atol=1e-6, err_msg=name)
