# SPDX-License-Identifier: BSD-3-Clause
"""Philox: the published answers, by the twin that walks meet to the bit; and chains of random loads."""

from __future__ import annotations

import numpy as np
import pytest

from tests import reference

ONES = 0xFFFFFFFF
# Known answers of Philox4x32-10 in Random123, the library of the method's authors: counter, key, block.
KNOWN = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((ONES,) * 4, (ONES, ONES), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


@pytest.mark.parametrize(("counter", "key", "block"), KNOWN)
def test_the_twin_of_walks_draws_the_published_blocks(counter, key, block):
    counters, seed = np.array([counter], np.uint32), key[0] | key[1] << 32
    assert reference.random_philox(counters, seed)[0].tolist() == list(block)


@pytest.mark.parametrize(
    ("items", "chains", "steps", "size"), [(1, 1, 1, 1), (7, 8, 5, 53), (65, 3, 20, 1000)]
)
def test_chains_of_loads_are_those_of_the_twin(device, items, chains, steps, size):
    words = np.random.default_rng(size).integers(0, 1 << 64, size, np.uint64)
    out = device.empty((items,), np.uint64)
    kernel = device.kernel("random", "random_loads", CHAINS=chains)
    kernel(items, 1, items, steps, size, device.upload(words, np.uint64), out)
    np.testing.assert_array_equal(out.get(), reference.random_loads(items, chains, steps, words))
