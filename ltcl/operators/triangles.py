# SPDX-License-Identifier: BSD-3-Clause
"""Inverses of large lower triangles on a GPU, joined two by two (`kernels/triangle.cl`).

    | A    |^-1   |     A^-1                |
    | L  C |    = | -C^-1 L A^-1      C^-1  |

Sweeps over rows take two launches a block: the larger its inverse, the fewer launches, but the more
bytes. Joining n rows up to blocks of B takes about n B^2 / 3 products of two numbers, once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ltcl.device import Array, Device, tuning
from ltcl.device.device import SPARE_BYTES
from ltcl.operators.rows import Slab

# Sweeps over a matrix, some ten solves, for which a block is chosen.
EXPECTED_SWEEPS = 100
# Launches of a block in a sweep.
BLOCK_LAUNCHES = 2
# Share of the memory up to which inverses and what they are joined from may take.
MEMORY_SHARE = 0.25
# Numbers of a side of what a work-item of triangle_join makes.
TILE = 4
GROUP_ITEMS = 64


def best_block(device: Device, n: int, least: int) -> int:
    """Rows of a block that take the least time: `least`, or as many times two as pay."""
    blocks = [least]
    while blocks[-1] < n and _has_room(device, n, 2 * blocks[-1]):
        blocks.append(2 * blocks[-1])
    if len(blocks) == 1:
        return least
    launch_seconds = tuning.overheads(device).launch
    bandwidth = tuning.bandwidth(device)

    def seconds(block: int) -> float:
        launches = BLOCK_LAUNCHES * -(-n // block)
        # Half of an inverse is zeros, which are not read.
        sweep = launches * launch_seconds + 2.0 * n * block / bandwidth
        # A work-item reads two sides of its tile for each number in a row of C^-1.
        joined_bytes = n * (block**2 - least**2) / 6
        return EXPECTED_SWEEPS * sweep + joined_bytes / bandwidth

    return min(blocks, key=seconds)


def _has_room(device: Device, n: int, block: int) -> bool:
    """True if the inverses fit in one buffer, and in memory beside those they are joined from."""
    nbytes = 4 * n * block
    is_one_buffer = nbytes + SPARE_BYTES <= device.max_allocation
    return is_one_buffer and 2 * nbytes <= MEMORY_SHARE * device.memory


def join(
    inverses: Array,
    block: int,
    slabs: Sequence[Slab],
    entries: Sequence[Mapping[str, Any]],
    scale: float,
    *,
    is_dense: bool,
) -> Array:
    """Inverses of the lower triangles of `block` rows of a matrix, (n, block).

    Parameters
    ----------
    inverses : Array, (n, size)
        Inverses of smaller triangles below each other; a multiple of four rows each.
    block : int
        `size` times a power of two.
    slabs : sequence of Slab
        Rows of M; below the triangles the matrix is scale M.
    entries : sequence of mappings
        The arguments of kernels that hold the entries of each slab.
    scale : float
    is_dense : bool
        Whether M has rows of numbers, without columns.
    """
    device = inverses.device
    defines = {"DENSE": 1} if is_dense else {}
    products_kernel = device.kernel("triangle", "triangle_products", **defines)
    join_kernel = device.kernel("triangle", "triangle_join", **defines)
    n, size = inverses.shape
    while size < block:
        products = device.empty((n, size))
        for slab, arguments in zip(slabs, entries, strict=True):
            products_kernel(
                slab.rows * size,
                GROUP_ITEMS,
                rows=slab.rows,
                first=slab.first,
                size=size,
                scale=scale,
                inverses=inverses,
                products=products,
                **arguments,
            )
        joined = device.empty((n, 2 * size))
        tiles = size // TILE
        pairs = -(-n // (2 * size))
        join_kernel(
            pairs * tiles * tiles,
            GROUP_ITEMS,
            n=n,
            size=size,
            inverses=inverses,
            products=products,
            out=joined,
        )
        inverses = joined
        size *= 2
    return inverses
