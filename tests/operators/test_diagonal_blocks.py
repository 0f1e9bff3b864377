# SPDX-License-Identifier: BSD-3-Clause
"""Operators of three colours as one: the same products, in as few launches as there can be."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

import ltcl
from ltcl.errors import InputError
from ltcl.operators import (
    CSR,
    BlockDiagonal,
    Compressed,
    Dense,
    Hats,
    IdentityPlus,
    Planes,
    ScaledColumns,
    SubsetBasis,
    Tiles,
    Wavelet,
    block_diagonal,
)
from ltcl.operators.diagonal_blocks import joined_once
from tests.conftest import launched_as
from tests.operators import helpers

GRID = (7, 9)
N = GRID[0] * GRID[1]
rng = np.random.default_rng(3)


def sparse(seed: int, scale: float = 1.0) -> scipy.sparse.csr_array:
    matrix = scipy.sparse.random_array((N, N), density=0.2, rng=np.random.default_rng(seed))
    return scipy.sparse.csr_array(0.1 * scale * matrix)


def compressed(device, scale: float, basis) -> Compressed:
    core = Tiles(device, sparse(1, scale)[: basis.shape[0], : basis.shape[0]], 1, "float16")
    return Compressed(core, basis, basis, 0.0)


def three(device, kind: str) -> list:
    """Three operators of one kind, of different sizes."""
    scales = (1.0, 0.25, 3e-4)
    if kind == "csr":
        return [CSR(device, sparse(seed, scale)) for seed, scale in enumerate(scales)]
    if kind == "dense":
        return [Dense(device, sparse(seed, scale).toarray()) for seed, scale in enumerate(scales)]
    if kind in ("float32", "float16", "int8"):
        return [Tiles(device, sparse(s, scale), 8, kind) for s, scale in enumerate(scales)]
    if kind == "tiles":
        formats = ((8, "int8"), (1, "float16"), (8, "float16"))
        return [Tiles(device, sparse(s, scales[s]), *f) for s, f in enumerate(formats)]
    if kind == "mixed":
        return [Dense(device, np.eye(N)), CSR(device, sparse(1)), Tiles(device, sparse(2))]
    if kind == "sizes":
        return [Dense(device, sparse(seed).toarray()[:n, :n]) for seed, n in enumerate((5, 9, 2))]
    if kind == "wide":
        return [Dense(device, sparse(seed).toarray()[:5]) for seed in range(3)]
    bases = {
        "wavelets": lambda: Wavelet(device, GRID, "db2"),
        "hats": lambda: Hats(device, GRID),
        "pixels": lambda: SubsetBasis(device, GRID, rng.permutation(N)[:20]),
        "support": lambda: SubsetBasis(
            device, GRID, rng.permutation(N)[:20], Wavelet(device, GRID, "haar")
        ),
    }
    if kind == "hats":
        W = bases[kind]()
        core = sparse(1).toarray()
        padded = np.zeros((W.shape[0], W.shape[0]))
        padded[:N, :N] = core
        return [Compressed(Dense(device, scale * padded), W, W, 0.0) for scale in scales]
    # Each has a basis of its own, as from a file, and a support of its own.
    return [compressed(device, scale, bases[kind]()) for scale in scales]


KINDS = ("csr", "dense", "float32", "float16", "int8", "tiles", "mixed", "wide", "sizes")
COMPRESSED = ("wavelets", "hats", "pixels", "support")


@pytest.mark.parametrize("kind", [*KINDS, *COMPRESSED])
def test_products_of_blocks(shaped, kind):
    """Those of the operators, one below the other, with all terms of an epilogue, both ways."""
    blocks = three(shaped, kind)
    joined = block_diagonal(blocks)
    matrix = np.asarray(scipy.linalg.block_diag(*[block.to_dense() for block in blocks]))
    assert joined.shape == matrix.shape
    helpers.meets_twin(joined, matrix)
    helpers.meets_twin(joined, matrix, transpose=True)


@pytest.mark.parametrize("transpose", [False, True])
def test_memory_of_others_does_not_matter(device, transpose):
    """Buffers that held NaN come back from the pool; what is not added is not read."""
    blocks = [ScaledColumns(Dense(device, np.eye(5, 9)), np.full(9, 2.0)) for _ in range(3)]
    joined = block_diagonal(blocks)
    rows, columns = joined.shape
    if transpose:
        rows, columns = columns, rows
    x = device.upload(np.ones(columns))
    for size in (5, 9, rows, columns):
        garbage = [device.upload(np.full(size, np.nan)) for _ in range(4)]
        del garbage
    found = joined.apply_transpose(x) if transpose else joined.apply(x)
    assert np.isfinite(found.get()).all()


@pytest.mark.parametrize("kind", ["csr", "float16", "wavelets"])
def test_systems_stay_systems(device, kind):
    """I + R of three colours is one I + R, and its solve is theirs."""
    systems = [IdentityPlus(R) for R in three(device, kind)]
    joined = block_diagonal(systems)
    assert isinstance(joined, IdentityPlus)
    b = rng.uniform(size=(3, N))
    x = ltcl.solve(joined, b.ravel(), rtol=1e-5).x.reshape(3, N)
    for channel, system in enumerate(systems):
        expected = np.linalg.solve(system.to_dense(), b[channel])
        np.testing.assert_allclose(x[channel], expected, rtol=0, atol=1e-4 * abs(expected).max())


@pytest.mark.parametrize("kind", ["csr", "float32", "float16", "int8", "tiles"])
def test_one_launch_of_small_rows(device, kind):
    blocks = three(device, kind)
    joined = block_diagonal(blocks)
    x = device.upload(np.ones(3 * N))
    product = joined.bind(x, x.like())
    before = device.launches.copy()
    product()
    assert (device.launches - before).total() == 1


def test_one_transform_of_all_planes(device):
    """As many launches as one picture takes."""
    W = Wavelet(device, (96, 64), "db2")
    pictures = Planes(W, 3)
    counts = []
    for basis in (W, pictures):
        x = device.upload(np.ones(basis.shape[1]))
        transform = basis.bind(x, x.like())
        before = device.launches.copy()
        transform()
        counts.append((device.launches - before).total())
    assert counts[0] == counts[1]


def test_large_blocks_are_not_copied(device, monkeypatch):
    monkeypatch.setattr("ltcl.operators.diagonal_blocks.MAX_JOINED_BYTES", 100)
    blocks = three(device, "csr")
    joined = block_diagonal(blocks)
    assert isinstance(joined, BlockDiagonal)
    assert joined.nbytes == sum(block.nbytes for block in blocks)


def test_other_blocks_are_joined_anew(device):
    """Also where a block that is gone had the memory of a new one."""
    first = IdentityPlus(CSR(device, sparse(0)))
    x = np.ones(2 * N)
    for seed in range(1, 6):
        # Garbage is gone at once, and its place is free for the next one.
        second = IdentityPlus(CSR(device, sparse(seed)))
        joined = joined_once([first, second])
        assert joined_once([first, second]) is joined
        expected = second.to_dense() @ x[N:]
        found = np.asarray(joined @ x)
        np.testing.assert_allclose(found[N:], expected, rtol=1e-5)
        del second


def test_facts_of_blocks(device):
    blocks = three(device, "mixed")
    joined = block_diagonal(blocks)
    expected = np.concatenate([block.diagonal() for block in blocks])
    np.testing.assert_array_equal(joined.diagonal(), expected)
    assert joined.norm_bound().value == max(block.norm_bound().value for block in blocks)


def test_blocks_on_one_device(device):
    another = launched_as(device, "gpu")
    with pytest.raises(InputError, match="blocks are on"):
        block_diagonal([Dense(device, np.eye(2)), Dense(another, np.eye(2))])
    with pytest.raises(InputError, match="blocks is empty"):
        block_diagonal([])
