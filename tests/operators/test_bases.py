# SPDX-License-Identifier: BSD-3-Clause
"""Orders of pixels, bases one after another, bases by name and from files."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Chained, Ordered, Pyramid, Wavelet, basis, basis_of, hilbert
from tests import gallery, reference
from tests.operators import helpers

GRIDS = ((1, 1), (3, 5), (1, 70), (9, 8))
LONG = 20000  # more pixels than there are items


def shuffled(n: int) -> np.ndarray:
    return np.random.default_rng(3).permutation(n)


@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("grid", GRIDS)
def test_orders_meet_their_twin(device, monkeypatch, grid, kind):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
    order = shuffled(grid[0] * grid[1])
    W = Ordered(device, grid, order)
    matrix = np.eye(len(order))[order]
    for indices, transpose in ((order, False), (np.argsort(order), True)):
        helpers.meets_twin(
            W,
            matrix,
            lambda *arguments, indices=indices: reference.ordered_gather(indices, *arguments),
            transpose=transpose,
        )
    np.testing.assert_array_equal(W.diagonal(), matrix.diagonal())
    assert W.nbytes == 8 * len(order)


def test_orders_lose_no_bit(device):
    x = gallery.vectors(LONG, 3)
    W = Ordered(device, (LONG, 1), shuffled(LONG))
    found = helpers.product(W, x)
    helpers.same_bits(found, x[W.order])
    helpers.same_bits(helpers.product(W.T, found), x)


def test_hilberts_order_goes_by_its_name(device):
    for W in (Ordered(device, (4, 6)), basis(device, (4, 6), "hilbert")):
        assert isinstance(W, Ordered)
        assert W.name == "hilbert"
        np.testing.assert_array_equal(W.order, hilbert((4, 6)))


@pytest.mark.parametrize(
    ("order", "part"),
    [
        ([0, 1, 2], "must be \\(4,\\)"),
        ([0, 1, 1, 3], "leaves out pixel 2; it must name each of 4 once"),
        ([0, 1, 2, 4], "leaves out pixel 3"),
        ([-1, 0, 1, 2], "leaves out pixel 3"),
        ([0.0, 1.0, 2.0, 3.0], "whole numbers"),
        ("peano", "order is 'peano'; it must be one of hilbert"),
    ],
)
def test_what_is_no_order_is_refused(device, order, part):
    with pytest.raises(InputError, match=part):
        Ordered(device, (2, 2), order)
    with pytest.raises(InputTypeError):
        Ordered(device, (2, 2), [None] * 4)


def test_chained_bases_act_one_after_another(device):
    inner = Wavelet(device, (5, 6), "db2")
    outer = Ordered(device, (5, 6), shuffled(30))
    W = Chained(outer, inner)
    matrix = inner.to_dense()[outer.order]
    # The matrix came from float32 itself: a unit more for each of its entries.
    for transpose in (False, True):
        for k in (None, 1, 3):
            x = gallery.vectors(30, k)
            add = gallery.vectors(30, k, 2)
            apply = W.apply_transpose if transpose else W.apply
            found = apply(device.upload(x), scale=-0.5, add=device.upload(add)).get()
            M = matrix.T if transpose else matrix
            helpers.close(found, -0.5 * M @ x + add, 2 * reference.product_error(M, x, 0.5, add))
    assert W.orthonormal
    assert W.grid == (5, 6)
    assert W.name == "db2, ordered"
    assert W.nbytes == inner.nbytes + outer.nbytes
    assert not Chained(Ordered(device, (44, 1), shuffled(44)), Pyramid(device, (5, 6))).orthonormal


def test_bases_that_do_not_fit_are_not_chained(device):
    with pytest.raises(InputError, match="outer is for 30 values; it must be for the 44 of inner"):
        Chained(Wavelet(device, (5, 6)), Pyramid(device, (5, 6)))
    with pytest.raises(InputError, match=r"it must be on .*, as inner is"):
        Chained(Wavelet(device, (5, 6)), Wavelet(Device(device.description), (5, 6)))


def test_bases_are_called_by_name(device):
    assert basis(device, (4, 6), "pixels") is None
    for name, kind in (("haar", Wavelet), ("db2", Wavelet), ("db4", Wavelet), ("pyramid", Pyramid)):
        W = basis(device, (4, 6), name)
        assert isinstance(W, kind)
        assert W.name == name
        assert W.grid == (4, 6)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("peano", "basis is 'peano'; it must be pixels, hilbert, pyramid or an orthonormal wavelet"),
        (None, "basis is None"),
        ("bior2.2", r"wavelet bior2\.2 is not orthonormal"),
    ],
)
def test_other_names_are_refused(device, name, part):
    with pytest.raises(InputError, match=part):
        basis(device, (4, 6), name)


@pytest.mark.parametrize("name", ["db2", "pyramid", "ordered", "chained"])
def test_bases_come_back_from_their_arrays(device, tmp_path, name):
    order = Ordered(device, (5, 6), shuffled(30), "mine")
    made = {
        "db2": lambda: Wavelet(device, (5, 6), "db2", 2),
        "pyramid": lambda: Pyramid(device, (5, 6)),
        "ordered": lambda: order,
        "chained": lambda: Chained(order, Chained(order, Wavelet(device, (5, 6), "haar"))),
    }[name]()
    np.savez(tmp_path / "basis.npz", **made.to_arrays())
    with np.load(tmp_path / "basis.npz", allow_pickle=False) as arrays:
        found = basis_of(device, dict(arrays))
    assert type(found) is type(made)
    assert (found.name, found.grid, found.orthonormal) == (made.name, made.grid, made.orthonormal)
    x = gallery.vectors(30, 2)
    helpers.same_bits(helpers.product(found, x), helpers.product(made, x))


@pytest.mark.parametrize(
    ("arrays", "part"),
    [
        ({}, "lack grid and name"),
        ({"name": "db2"}, "lack grid"),
        ({"name": "pixels", "grid": [2, 2]}, "pixels, which is no basis"),
        ({"name": "haar", "grid": [2, 2], "levels": 9}, "levels is 9"),
        ({"name": "haar", "grid": [2], "levels": 1}, "grid is"),
        ({"outer.name": "haar"}, "lack grid"),
    ],
)
def test_arrays_that_describe_no_basis_are_refused(device, arrays, part):
    with pytest.raises(InputError, match=part):
        basis_of(device, arrays)
