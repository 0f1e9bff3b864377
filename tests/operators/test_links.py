# SPDX-License-Identifier: BSD-3-Clause
"""Tables that three channels share: a step is the row of each in the mean, and of equal ones their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import scipy.sparse

from ltcl.errors import MemoryLimitError
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import tables
from ltcl.operators.links import Links, links
from tests import gallery

SIGNS = (1.0, 1.0, -1.0)


def _apart() -> list[np.ndarray]:
    """Each channel has places and empty rows of its own, the last row is empty in all."""
    found = [gallery.sparse(37, 37, 0.2, seed).toarray() * 10.0**-seed for seed in range(3)]
    for c, M in enumerate(found):
        M[[c, 10 + c, 36]] = 0
    return found


CHANNELS = {
    "1x1": [np.array([[value]], np.float32) for value in (0.5, -0.25, 0.0)],
    "nothing": [np.zeros((3, 3), np.float32)] * 3,
    "apart": _apart(),
    "like a scene": [gallery.bounces(23, rho) * (1 + seed) for seed, rho in enumerate((0.1, 0.5, 0.2))],
    "one is dark": [gallery.signed(19, 19), np.zeros((19, 19), np.float32), gallery.signed(19, 19, 3)],
    "far apart": [gallery.signed(9, 9, seed) * scale for seed, scale in enumerate((1e-20, 1.0, 1e15))],
}
FORMS = {
    "csr": lambda device, M, c: CSR(device, scipy.sparse.csr_array(M)),
    "dense": lambda device, M, c: Dense(device, M),
    "both": lambda device, M, c: Dense(device, M) if c == 1 else CSR(device, scipy.sparse.csr_array(M)),
}


def made_of(device, name: str, form: str, sampler: str = "alias") -> Links:
    return links([FORMS[form](device, M, c) for c, M in enumerate(CHANNELS[name])], SIGNS, sampler)


def drawn(made: Links, row: int) -> np.ndarray:
    """The probability of each entry of a row, by its alias table."""
    start, _, count, _ = made.records.get()[row].tolist()
    found = np.zeros(count)
    for entry in made.entries.get()[start : start + count].tolist():
        threshold = (entry >> 46) / 2**18
        found[entry >> 24 & 0x3FFFFF] += threshold / count
        found[entry >> 1 & 0x3FFFFF] += (1 - threshold) / count
    return found


def step_of(made: Links, row: int) -> np.ndarray:
    """What a step from a row is in the mean, (3, N)."""
    start, _, count, _ = made.records.get()[row].tolist()
    entries, mean = made.links.get()[start : start + count], np.zeros((3, made.shape[1]))
    for bits, total in zip(entries.T[1:], mean, strict=True):
        np.add.at(total, entries[:, 0], drawn(made, row) * bits.view(np.float32))
    return mean


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", CHANNELS)
def test_a_step_is_the_row_of_every_channel_in_the_mean(device, name, form):
    """Within 2^-18 of the row in total variation, as alias tables are, times the largest factor."""
    made = made_of(device, name, form)
    for row in range(made.shape[0]):
        for sign, M, found in zip(SIGNS, CHANNELS[name], step_of(made, row), strict=True):
            wanted = sign * M[row].astype(np.float64)
            assert np.abs(found - wanted).sum() <= 2**-17 * 3 * np.abs(wanted).sum()


@pytest.mark.parametrize("sampler", ["alias", "cdf", "uniform"])
@pytest.mark.parametrize("form", ["csr", "dense"])
def test_equal_channels_have_the_table_of_one(device, form, sampler):
    M = gallery.sparse(29, 29, 0.4, 7).toarray()
    Rs = [FORMS[form](device, M, c) for c in range(3)]
    made, own = links(Rs, (1.0, 1.0, -1.0), sampler), tables(Rs[0], sampler)
    assert made.records.get().tolist() == own.records.get().tolist()
    nonzero = np.ones(own.entries.size, bool) if form == "csr" else M.ravel() != 0
    signed = np.sign(M.ravel()[M.ravel() != 0])
    if sampler == "uniform":
        wanted = own.counts().astype(np.float32).repeat(own.counts())[nonzero] * M.ravel()[M.ravel() != 0]
    else:
        wanted = own.sums().repeat(own.counts())[nonzero] * signed
    factors = made.links.get()[nonzero, 1:].view(np.float32)
    for sign, found in zip((1, 1, -1), factors.T, strict=True):
        np.testing.assert_array_equal(found, sign * wanted)


@pytest.mark.parametrize("sampler", ["alias", "uniform"])
@pytest.mark.parametrize("name", ["apart", "like a scene", "one is dark"])
def test_second_moments_are_those_of_a_step(device, name, sampler):
    """R^2 / p of each channel; by the alias table at most three times what the channel has by itself."""
    made = made_of(device, name, "csr", sampler)
    for M, Q in zip(CHANNELS[name], made.moments(), strict=True):
        M = M.astype(np.float64)
        found, own = Q.to_dense(), np.abs(M).sum(axis=1)
        if sampler == "uniform":
            np.testing.assert_allclose(found, made.counts()[:, None] * M**2, rtol=1e-6)
            continue
        assert np.all((found > 0) == (M != 0))
        # Its own p is |M| / own; what is shared, p = M^2 / Q, sums to at most 1 over entries that it has.
        p = np.divide(M**2, found, out=np.zeros_like(M), where=found > 0)
        assert np.all(p.sum(axis=1) <= 1 + 1e-6)
        assert np.all(found.sum(axis=1) <= 3 * own**2 * (1 + 1e-6))


def rows_of(device, seeds: Sequence[int] = (0, 1, 2)) -> list[Dense]:
    return [Dense(device, gallery.signed(9, 9, seed)) for seed in seeds]


def test_they_are_made_once_and_take_24_bytes_an_entry(device):
    Rs = rows_of(device)
    made = links(Rs, (1, 1, 1))
    assert links(Rs, (1, 1, 1)) is made
    assert links(Rs, (1, 1, -1)) is not made
    assert links(Rs, (1, 1, 1), "cdf") is not made
    assert links([Rs[0], Rs[2], Rs[1]], (1, 1, 1)).others == (Rs[2], Rs[1])
    assert made.nbytes == 9 * 9 * 24 + 9 * 16


def test_links_beyond_the_largest_buffer_are_refused(small_device):
    Rs = [CSR(small_device, scipy.sparse.csr_array(gallery.signed(18, 18, seed))) for seed in range(3)]
    with pytest.raises(MemoryLimitError, match=r"tables of the 324 entries of R need 5.062 KiB .* 3.984 KiB"):
        links(Rs, (1, 1, 1))
