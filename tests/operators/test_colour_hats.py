# SPDX-License-Identifier: BSD-3-Clause
"""Three colours of a sketch as one operator: products, entries of both sizes, what is shared."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.operators import (
    CSR,
    Compressed,
    Hats,
    IdentityPlus,
    ScaledBasis,
    ScaledColumns,
    block_diagonal,
    colour_hats,
    stored,
)
from ltcl.operators.colour_hats import (
    ColourHats,
    mixed_colours,
    scale_columns,
    share_entries,
)
from tests import reference
from tests.operators import helpers

GRIDS = ((1, 1), (1, 2), (3, 5), (13, 7), (2, 70))
MIXING = np.array([[1.0, 0.1, 0.0], [0.02, 0.9, 0.1], [0.0, -0.03, 1.1]])


def few_bits(values: np.ndarray) -> np.ndarray:
    """Values of 8 significant bits."""
    bits = values.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF0000)
    return bits.view(np.float32)


class Colours:
    """The parts of three colours on a grid: K, w, and the scale of columns."""

    def __init__(self, device: ltcl.Device, grid: tuple[int, int], bits: int = 8) -> None:
        random = np.random.default_rng(5)
        self.W = Hats(device, grid)
        nodes, pixels = self.W.shape
        self.pixels = pixels
        self.scale = random.uniform(0.5, 1.5, (3, pixels))
        self.inner = random.uniform(0.5, 2.0, (3, pixels))
        self.inner[:, ::5] = 0.0
        self.cores = []
        for _ in range(3):
            core = 0.1 * random.standard_normal((nodes, nodes))
            # Rows without entries, and places that other colours do not have.
            core *= random.random((nodes, nodes)) < min(1.0, 8.0 / nodes)
            if bits == 8:
                core = few_bits(core).astype(np.float64)
            core[np.arange(pixels), np.arange(pixels)] = random.uniform(0.5, 1.0, pixels)
            self.cores.append(core)

    def blocks(self, shift: np.ndarray | float = 0.0) -> list[ScaledColumns]:
        """Each colour as an operator: (I + diag(w) W^T K W) diag(inner) - diag(shift)."""
        blocks = []
        for core, scale, inner in zip(self.cores, self.scale, self.inner, strict=True):
            K = CSR(self.W.device, scipy.sparse.csr_array(core))
            out = ScaledBasis(Hats(self.W.device, self.W.grid), scale)
            S = IdentityPlus(Compressed(K, out, self.W, 0.0))
            own_shift = np.where(inner > 0.0, shift, 0.0) if np.any(shift) else 0.0
            blocks.append(ScaledColumns(S, inner, own_shift))
        return blocks

    def matrix(self, shift: float = 0.0, mixing: np.ndarray | None = None) -> np.ndarray:
        """All colours, (3 N, 3 N), by the twins of the kernels."""
        W = reference.hats_gather(self.W.grid)
        cores = np.stack(self.cores).astype(np.float32)
        size = 3 * self.pixels
        matrix = np.empty((size, size))
        M = np.eye(3) if mixing is None else mixing
        for column, unit in enumerate(np.eye(size)):
            operand = unit.reshape(3, -1)
            pixels = reference.colour_hats_scale(operand, self.inner, M)
            light = reference.colour_hats_rows(cores, pixels @ W.T)
            seen = pixels + reference.colour_hats_finish(W, light, self.scale)
            matrix[:, column] = (seen - shift * (self.inner > 0.0) * operand).ravel()
        return matrix


@pytest.mark.parametrize("bits", [8, 24])
@pytest.mark.parametrize("grid", GRIDS)
def test_products_meet_their_twins(shaped, grid, bits):
    colours = Colours(shaped, grid, bits)
    joined = block_diagonal(colours.blocks(shift=-0.5))
    assert isinstance(joined, ColourHats)
    # One pixel has its own entry alone, which is not among these.
    assert joined.rows.forward.is_narrow == (bits == 8 or grid == (1, 1))
    matrix = colours.matrix(shift=-0.5)
    helpers.meets_twin(joined, matrix)
    helpers.meets_twin(joined, matrix, transpose=True)


@pytest.mark.parametrize("grid", GRIDS[1:])
def test_colours_of_a_pixel_are_mixed(shaped, grid):
    colours = Colours(shaped, grid)
    mixed = mixed_colours(colours.blocks(), MIXING)
    assert isinstance(mixed, ColourHats)
    matrix = colours.matrix(mixing=MIXING)
    helpers.meets_twin(mixed, matrix)
    helpers.meets_twin(mixed, matrix, transpose=True)
    d = np.random.default_rng(6).uniform(0.0, 2.0, len(matrix))
    scaled = scale_columns(mixed, d)
    assert isinstance(scaled, ColourHats)
    helpers.meets_twin(scaled, matrix * d)
    helpers.meets_twin(scaled, matrix * d, transpose=True)
    twice = scale_columns(scaled, d)
    helpers.meets_twin(twice, matrix * d**2)


def test_nodes_that_are_too_far_take_wide_entries(device, monkeypatch):
    monkeypatch.setattr(colour_hats, "MAX_DISTANCE", 8)
    colours = Colours(device, (13, 7))
    joined = block_diagonal(colours.blocks())
    assert isinstance(joined, ColourHats)
    assert not joined.rows.forward.is_narrow
    helpers.meets_twin(joined, colours.matrix())


def test_direct_light_leaves_nothing_of_its_own(device):
    """R = T F^-1 - I has no diagonal of its own where F is the light of each pixel's own."""
    colours = Colours(device, (13, 7))
    own = np.stack([np.diag(core)[: colours.pixels] for core in colours.cores])
    colours.inner = 1.0 / (1.0 + colours.scale * own)
    R = block_diagonal(colours.blocks(shift=1.0))
    assert isinstance(R, ColourHats)
    assert R._factors.own is None
    helpers.meets_twin(R, colours.matrix(shift=1.0))


def test_entries_are_shared(device):
    """T and the systems S have the same K, which lies on the device once."""
    colours = Colours(device, (13, 7))
    blocks = colours.blocks()
    cores = [block.A for block in blocks]
    systems = [IdentityPlus(ScaledColumns(S, colours.inner[0], 0.0)) for S in cores]
    assert share_entries(blocks)
    assert share_entries(systems)
    T = block_diagonal(blocks)
    S = block_diagonal(systems)
    assert isinstance(T, ColourHats)
    assert isinstance(S, IdentityPlus)
    assert isinstance(S.R, ColourHats)
    assert T.rows is S.R.rows


def test_matrices_of_a_colour_are_uploaded_at_their_first_product(device):
    """A T from arrays has the entries of all colours alone, until one is multiplied alone."""
    colours = Colours(device, (13, 7))
    blocks = colours.blocks()
    systems = [block.A for block in blocks if isinstance(block.A, IdentityPlus)]
    arrays = stored.to_arrays(systems)
    read = stored.from_arrays(device, arrays)
    cores = [S.R.core for S in read if isinstance(S.R, Compressed)]
    of_colours = [ScaledColumns(S, d) for S, d in zip(read, colours.inner, strict=True)]
    x = np.random.default_rng(7).random(3 * colours.pixels)
    expected = colours.matrix() @ x
    joined = block_diagonal(of_colours)
    np.testing.assert_allclose(helpers.product(joined, x), expected, rtol=1e-5, atol=1e-5)
    assert not any(core.arrays() for core in cores)
    for A, part, seen in zip(of_colours, np.split(x, 3), np.split(expected, 3), strict=True):
        np.testing.assert_allclose(helpers.product(A, part), seen, rtol=1e-5, atol=1e-5)
    assert all(core.arrays() for core in cores)


def test_others_stay_as_they_are(device):
    colours = Colours(device, (3, 5))
    two = colours.blocks()[:2]
    assert not isinstance(block_diagonal(two), ColourHats)
    other = Colours(device, (5, 3)).blocks()
    assert not share_entries([*two, other[2]])
    dense = ScaledColumns(IdentityPlus(CSR(device, scipy.sparse.eye_array(15))), np.ones(15))
    assert not share_entries([*two, dense])
    assert not isinstance(mixed_colours([*two, dense], MIXING), ColourHats)
    # A diagonal in columns that are 0 belongs to no node.
    shifted = Colours(device, (3, 5))
    blocks = shifted.blocks()
    of_second = blocks[1]
    blocks[1] = ScaledColumns(of_second.A, of_second.d, np.ones(15))
    assert not isinstance(block_diagonal(blocks), ColourHats)
    helpers.meets_twin(block_diagonal(shifted.blocks()), shifted.matrix())
