# SPDX-License-Identifier: BSD-3-Clause
"""Operators as plain arrays: the same bits come back, and nothing that arrays say is believed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    IdentityPlus,
    Pyramid,
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

SYSTEMS = ("core", "rows", "two-sided", "chained", "subset", "nested", "pixels", "pyramid", "two")


def _systems(device, core: Any = "csr") -> dict[str, IdentityPlus]:
    """Every kind of operator and basis that can be kept."""
    W, order = Wavelet(device, GRID, "db2"), np.random.default_rng(0).permutation(N)
    C = SubsetBasis(device, GRID, order, of=Wavelet(device, GRID, "haar", 1))
    V, D = (SubsetBasis(device, GRID, order[:11], of=of) for of in (W, C))
    Q, P = SubsetBasis(device, GRID, order[:11]), Pyramid(device, GRID)

    def kept(out: Any, into: Any, **options: Any) -> Compressed:
        n = next((W.shape[0] for W in (into, out) if W is not None), N)
        return Compressed(helpers.FORMATS[core](device, gallery.sparse(n, n)), out, into, **options)

    return {
        "core": IdentityPlus(kept(None, None).core),
        "rows": IdentityPlus(kept(None, W), -1),
        "two-sided": IdentityPlus(kept(W, W, error=0.25), solution_error=0.5),
        "chained": IdentityPlus(kept(C, C), weights=np.arange(1.0, N + 1)),
        "subset": IdentityPlus(kept(V, V, error=0.1), solution_error=0.2),
        "nested": IdentityPlus(kept(D, D, error=0.1)),
        "pixels": IdentityPlus(kept(Q, Q, error=0.1)),
        "pyramid": IdentityPlus(kept(P, P, error=0.1, diagonal=np.arange(N))),
        "two": IdentityPlus(kept(W, C), solution_error=np.inf),
    }


@pytest.mark.parametrize("core", helpers.FORMATS)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_same_bits_come_back(device, name, core):
    a = _systems(device, core)[name]
    arrays = stored.to_arrays([a])
    assert all(array.dtype.kind in "fiuU" for array in arrays.values())
    (b,) = stored.from_arrays(device, arrays)
    assert (a.shape, a.sign, a.error, a.solution_error) == (
        b.shape,
        b.sign,
        b.error,
        b.solution_error,
    )
    assert a.nbytes == b.nbytes
    np.testing.assert_array_equal(a.weights, b.weights)
    for x in (gallery.vectors(N, None), gallery.vectors(N, 3)):
        on_device = device.upload(x)
        helpers.same_bits(b.apply(on_device).get(), a.apply(on_device).get())
        helpers.same_bits(b.apply_transpose(on_device).get(), a.apply_transpose(on_device).get())
    if isinstance(a.R, Compressed) and isinstance(b.R, Compressed):
        assert b.R.two_sided == a.R.two_sided
        assert (b.R.known_diagonal is None) == (a.R.known_diagonal is None)
        for old, new in ((a.R.out, b.R.out), (a.R.into, b.R.into)):
            if old is not None and new is not None:
                assert type(old) is type(new)
                assert (old.name, old.grid, old.orthonormal) == (
                    new.name,
                    new.grid,
                    new.orthonormal,
                )


def test_what_channels_share_is_kept_and_made_once(device):
    W = Wavelet(device, GRID, "db2")
    matrix = gallery.sparse(N, N)
    others = [CSR(device, matrix * scale) for scale in (1, 2, 3)]
    arrays = stored.to_arrays([IdentityPlus(Compressed(core, W, W)) for core in others])
    assert sum(name.startswith("basis_") and name.endswith(".name") for name in arrays) == 1
    found = [S.R for S in stored.from_arrays(device, arrays)]
    assert len({R.into for R in found if isinstance(R, Compressed)}) == 1
    assert (
        len(
            {R.core.pattern for R in found if isinstance(R, Compressed) and isinstance(R.core, CSR)}
        )
        == 1
    )


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
    arrays = stored.to_arrays([_systems(device)["two-sided"]]) | changes
    arrays = {key: value for key, value in arrays.items() if value is not None}
    with pytest.raises((InputError, InputTypeError), match=part) as caught:
        stored.from_arrays(device, arrays)
    assert "\n" not in str(caught.value)
