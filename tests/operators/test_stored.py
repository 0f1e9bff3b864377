# SPDX-License-Identifier: BSD-3-Clause
"""Operators as plain arrays: the same bits come back, and arrays are checked."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Basis,
    Compressed,
    Dense,
    Hats,
    IdentityPlus,
    PatchHats,
    Pyramid,
    ScaledBasis,
    ScaledColumns,
    SubsetBasis,
    Wavelet,
    stored,
)
from tests import gallery
from tests.operators import helpers

GRID = (5, 7)
N = 35
NNZ = gallery.sparse(N, N).nnz

SYSTEMS = (
    "core",
    "rows",
    "two-sided",
    "chained",
    "subset",
    "nested",
    "pixels",
    "pyramid",
    "hats",
    "patch hats",
    "scaled",
    "two",
)


def core_between(device: Device, form: str, out: Any, into: Any, **options: Any) -> Compressed:
    """A random core of a format between two bases."""
    if into is not None:
        n = into.shape[0]
    elif out is not None:
        n = out.shape[0]
    else:
        n = N
    core = helpers.FORMATS[form](device, gallery.sparse(n, n))
    return Compressed(core, out, into, **options)


def make_system(device: Device, name: str, form: str = "csr") -> IdentityPlus:
    """A system of each kind of operator and basis that can be kept."""
    order = np.random.default_rng(0).permutation(N)
    W = Wavelet(device, GRID, "db2")
    C = SubsetBasis(device, GRID, order, of=Wavelet(device, GRID, "haar", 1))
    between = partial(core_between, device, form)
    if name == "core":
        return IdentityPlus(between(None, None).core)
    if name == "rows":
        return IdentityPlus(between(None, W), -1)
    if name == "two-sided":
        return IdentityPlus(between(W, W, error=0.25), solution_error=0.5)
    if name == "chained":
        return IdentityPlus(between(C, C), weights=np.arange(1.0, N + 1))
    if name == "subset":
        some = SubsetBasis(device, GRID, order[:11], of=W)
        return IdentityPlus(between(some, some, error=0.1), solution_error=0.2)
    if name == "nested":
        some = SubsetBasis(device, GRID, order[:11], of=C)
        return IdentityPlus(between(some, some, error=0.1))
    if name == "pixels":
        some = SubsetBasis(device, GRID, order[:11])
        return IdentityPlus(between(some, some, error=0.1))
    if name in ("pyramid", "hats"):
        P = Pyramid(device, GRID) if name == "pyramid" else Hats(device, GRID)
        return IdentityPlus(between(P, P, error=0.1, diagonal=np.arange(N)))
    if name == "patch hats":
        P = PatchHats(device, GRID, walls=7, detail=1)
        return IdentityPlus(between(P, P, error=0.1))
    if name == "scaled":
        P = Pyramid(device, GRID)
        out = ScaledBasis(P, np.linspace(0.2, 1.0, N))
        return IdentityPlus(between(out, P, error=0.1, diagonal=np.arange(N)))
    return IdentityPlus(between(W, C), solution_error=np.inf)


@pytest.mark.parametrize("form", helpers.FORMATS)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_same_bits_come_back(device, name, form):
    a = make_system(device, name, form)
    arrays = stored.to_arrays([a])
    assert all(array.dtype.kind in "fiuU" for array in arrays.values())
    (b,) = stored.from_arrays(device, arrays)
    for fact in ("shape", "sign", "error", "solution_error", "nbytes"):
        assert getattr(a, fact) == getattr(b, fact)
    np.testing.assert_array_equal(a.weights, b.weights)
    for k in (None, 3):
        x = device.upload(gallery.vectors(N, k))
        helpers.same_bits(b.apply(x).get(), a.apply(x).get())
        helpers.same_bits(b.apply_transpose(x).get(), a.apply_transpose(x).get())
    if isinstance(a.R, Compressed) and isinstance(b.R, Compressed):
        assert b.R.two_sided == a.R.two_sided
        assert (b.R.known_diagonal is None) == (a.R.known_diagonal is None)
        check_basis(a.R.out, b.R.out)
        check_basis(a.R.into, b.R.into)


def check_basis(before: Basis | None, after: Basis | None) -> None:
    """Assert that a basis has come back."""
    assert type(before) is type(after)
    if before is not None and after is not None:
        assert before.name == after.name
        assert before.grid == after.grid
        assert before.orthonormal == after.orthonormal


def test_bases_and_patterns_of_channels_are_kept_and_made_once(device):
    W = Wavelet(device, GRID, "db2")
    matrix = gallery.sparse(N, N)
    systems = []
    for scale in (1, 2, 3):
        core = CSR(device, matrix * scale)
        systems.append(IdentityPlus(Compressed(core, W, W)))
    arrays = stored.to_arrays(systems)
    assert "basis_0.name" in arrays
    assert "basis_1.name" not in arrays
    bases = set()
    patterns = set()
    for S in stored.from_arrays(device, arrays):
        R: Any = S.R
        bases.add(R.into)
        patterns.add(R.core.pattern)
    assert len(bases) == 1
    assert len(patterns) == 1


def test_other_operators_cannot_be_kept(device):
    A = ScaledColumns(Dense(device, np.eye(3)), np.ones(3))
    for R in (A, Compressed(A, None, None)):
        with pytest.raises(InputTypeError, match="R holds a ScaledColumns"):
            stored.to_arrays([IdentityPlus(R)])


BAD = {
    "no kind": ({"system_0.R.kind": None}, "lack 'kind'"),
    "no core": ({"system_0.R.core.kind": None}, "lack 'kind'"),
    "another kind": (
        {"system_0.R.core.kind": np.array("pickle")},
        "kind .* is 'pickle'; .* compress again",
    ),
    "no values": ({"system_0.R.core.data": None}, "lack 'data'"),
    "column beyond": (
        {"system_0.R.core.indices": np.full(NNZ, 35, np.int32)},
        "holds 35; column indices",
    ),
    "column before": (
        {"system_0.R.core.indices": np.full(NNZ, -1, np.int32)},
        "holds -1; column indices",
    ),
    "columns of reals": ({"system_0.R.core.indices": np.full(NNZ, 1.0)}, "vector of integers"),
    "falling pointers": (
        {"system_0.R.core.indptr": np.r_[0, 5, 3, np.full(33, NNZ)]},
        "must never fall",
    ),
    "short pointers": ({"system_0.R.core.indptr": np.array([0])}, "indptr has 1 entries"),
    "no pointers": ({"system_0.R.core.indptr": np.array([], np.int64)}, "indptr has 0 entries"),
    "another length": ({"system_0.R.core.data": np.ones(3, np.float32)}, "the three must agree"),
    "another shape": (
        {"system_0.R.core.shape": np.array([35, 1 << 62])},
        "into has 35 coefficients",
    ),
    "a shape of one": ({"system_0.R.core.shape": np.array([35])}, "do not fit"),
    "NaN": ({"system_0.R.core.data": np.full(NNZ, np.nan, np.float32)}, "NaN"),
    "words for values": ({"system_0.R.core.data": np.full(NNZ, "a")}, "must hold real numbers"),
    "basis that is not there": (
        {"system_0.R.out": np.array(7)},
        "lack grid and name; compress again",
    ),
    "half a basis": ({"system_0.R.out": np.array([0, 0])}, "do not fit"),
    "basis of another grid": ({"basis_0.grid": np.array([6, 6])}, "36 coefficients, but the core"),
    "basis of no side": ({"basis_0.grid": np.array([2])}, "grid is"),
    "no basis": ({"basis_0.name": np.array("pixels"), "basis_0.levels": None}, "pixels"),
    "biorthogonal": ({"basis_0.name": np.array("bior2.2")}, "bior2.2"),
    "too many levels": ({"basis_0.levels": np.array(99)}, "levels is 99"),
    "sign": ({"system_0.sign": np.array(3.0)}, "sign is 3.0"),
    "error below 0": ({"system_0.R.error": np.array(-1.0)}, "error is -1.0"),
    "solution error NaN": ({"system_0.solution_error": np.array(np.nan)}, "solution_error is nan"),
    "weights of no one": ({"system_0.weights": np.zeros(N)}, "not all positive"),
    "weights of others": ({"system_0.weights": np.ones(3)}, r"weights has shape \(3,\)"),
    "diagonal": ({"system_0.R.diagonal": np.ones(2)}, r"diagonal has shape \(2,\)"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_arrays_are_refused_in_one_line(device, name):
    changes, part = BAD[name]
    arrays = stored.to_arrays([make_system(device, "two-sided")]) | changes
    arrays = {key: value for key, value in arrays.items() if value is not None}
    with pytest.raises((InputError, InputTypeError), match=part) as caught:
        stored.from_arrays(device, arrays)
    assert "\n" not in str(caught.value)
