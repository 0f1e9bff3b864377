# SPDX-License-Identifier: BSD-3-Clause
"""Some coefficients of a basis, and which of them a core acts on."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR, Chained, Compressed, Ordered, Pyramid, Selected, Wavelet, active, chosen
from ltcl.operators.named_bases import basis_of
from tests import gallery, reference
from tests.operators import helpers


def some(n: int) -> np.ndarray:
    """A third of n places, or one, in no order."""
    return np.random.default_rng(4).permutation(n)[: max(1, n // 3)]


@pytest.mark.parametrize("kind", ["cpu", "gpu"])
@pytest.mark.parametrize("grid", [(1, 1), (3, 5), (1, 70), (9, 8)])
def test_a_selection_meets_its_twin(device, monkeypatch, grid, kind):
    monkeypatch.setattr(Device, "is_cpu", property(lambda _: kind == "cpu"))
    n = grid[0] * grid[1]
    places = some(n)
    P = Selected(device, grid, places)
    matrix = np.eye(n)[places]
    helpers.meets_twin(P, matrix, lambda *arguments: reference.ordered_gather(places, *arguments))
    helpers.meets_twin(
        P, matrix, lambda *arguments: reference.ordered_scatter(places, n, *arguments), transpose=True
    )
    assert P.nbytes == 4 * len(places)
    assert P.isometric
    assert P.orthonormal == (n == 1)


def test_chosen_coefficients_are_rows_of_the_basis(device):
    W = Wavelet(device, (5, 6), "db2")
    order = np.random.default_rng(3).permutation(30)
    places = some(30)
    kinds = {
        "wavelet": (W, "db2, selected"),
        "ordered": (Ordered(device, (5, 6), order), "selected"),
        "chained": (Chained(Ordered(device, (5, 6), order), W), "db2, selected"),
    }
    for basis, name in kinds.values():
        V = chosen(basis, places)
        np.testing.assert_array_equal(V.to_dense(), basis.to_dense()[places])
        assert (V.name, V.grid, V.shape) == (name, (5, 6), (10, 30))
        assert V.isometric
        assert not V.orthonormal
        again = basis_of(device, V.to_arrays())
        x = gallery.vectors(30, 3)
        helpers.same_bits(helpers.product(again, x), helpers.product(V, x))
        assert (again.isometric, again.orthonormal) == (True, False)
    assert not chosen(Pyramid(device, (5, 6)), places).isometric


def test_rows_and_columns_in_use_are_active():
    def core(*entries):
        rows, columns = np.array(entries).reshape(-1, 2).T
        return scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(8, 8))

    np.testing.assert_array_equal(active(core((7, 1), (2, 2), (7, 3))), [1, 2, 3, 7])
    assert active(core((7, 1), (2, 2), (7, 3), (0, 0))) is None  # five of eight
    np.testing.assert_array_equal(active(core()), [0])


def test_the_diagonal_of_chosen_pixels_is_that_of_the_core(device):
    places = some(12)
    P = Selected(device, (3, 4), places)
    C = gallery.sparse(4, 4)
    R = Compressed(CSR(device, C), P, P)
    assert R.two_sided
    np.testing.assert_array_equal(R.diagonal(), R.to_dense().diagonal())


@pytest.mark.parametrize(
    ("places", "part"),
    [
        ([], r"has shape \(0,\)"),
        ([[0, 1]], r"has shape \(1, 2\)"),
        ([0.5], "of float64; it must be"),
        ([0, 4], "reach from 0 to 4; they must be among 4"),
        ([-1, 2], "reach from -1 to 2"),
        ([1, 1], "twice"),
    ],
)
def test_what_is_no_selection_is_refused(device, places, part):
    with pytest.raises(InputError, match=part):
        Selected(device, (2, 2), places)
    with pytest.raises(InputTypeError):
        Selected(device, (2, 2), [None])
