# SPDX-License-Identifier: BSD-3-Clause
"""Tables and walks: to the bit those of the twin, however launched; lengths by eq. 24 and 25."""

from __future__ import annotations

import weakref

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import MemoryLimitError
from ltcl.operators import CSR, Dense, IdentityPlus
from ltcl.operators.walks import (
    CHUNK,
    Lengths,
    Sums,
    Tables,
    Walker,
    linked,
    rows_of_R,
    squares,
    tables,
    tables_of_columns,
)
from tests import gallery, reference
from tests.operators import helpers

SEED = 0x0123456789ABCDEF
TINY = float(np.finfo(np.float32).tiny)
# Rows that are hard to scale: of one value, of zeros, huge, denormal, spread over all of float32.
HARD = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, -3e38, 0.0, 0.0, 0.0],
        [1e-45, 3e-45, 0.0, -1e-44, 0.0],
        [TINY, -TINY, TINY, TINY, 1e-45],
        [1.0, 1e-30, -1e-38, 1e30, 1.0],
        [8.5e37, -8.5e37, 8.5e37, 8.5e37, 0.0],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        [1.0, 1.0, 1.0, 1.0, np.nextafter(np.float32(1), np.float32(2))],
    ],
    np.float32,
)
DENSE = gallery.DENSE | {"hard": HARD}
EMPTY_ROWS = np.where(
    np.isin(np.arange(53), [0, 7, 52])[:, None], 0, gallery.sparse(53, 53).toarray() / 12
)
# R of one channel, or of three with signs, places and empty rows of their own.
SCENES = {
    "1x1": [np.array([[-0.5]], np.float32)],
    "no entries": [np.zeros((3, 3), np.float32)],
    "signs, empty rows": [EMPTY_ROWS],
    "strong rows": [gallery.SPARSE["strong rows"].toarray() / np.float32(150)],
    "positive": [gallery.bounces(29, 0.6)],
    "three 1x1": [np.array([[value]], np.float32) for value in (0.5, -0.25, 0.0)],
    "three without entries": [np.zeros((3, 3), np.float32)] * 3,
    "apart": [EMPTY_ROWS, *(gallery.sparse(53, 53, 0.3 - c / 10, c).toarray() / 9 for c in (1, 2))],
    "alike": [gallery.bounces(29, rho) for rho in (0.6, 0.3, 0.5)],
    "far apart": [
        gallery.signed(9, 9, seed) * scale for seed, scale in enumerate((1e-20, 0.1, 0.1))
    ],
}
COLOURS = [name for name, channels in SCENES.items() if len(channels) == 3]
SIGNS = (1.0, 1.0, -1.0)


def tables_of(device, name: str) -> Tables:
    """Tables of one channel, or linked tables of three, of which the second is dense."""
    Rs = []
    for channel, R in enumerate(SCENES[name]):
        form = "dense" if channel == 1 else "csr"
        Rs.append(helpers.FORMATS[form](device, R))
    return linked(Rs, SIGNS) if len(Rs) == 3 else tables(*Rs)


def drawn(made: Tables, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Column with sign, and chance, of what an alias table draws."""
    start, _, count, _ = made.records.get()[row].tolist()
    entries = made.entries.get()[start : start + count].tolist()
    own = [entry >> 23 & 0x7FFFFF for entry in entries]
    aliases = [entry & 0x7FFFFF for entry in entries]
    threshold = np.array([entry >> 46 for entry in entries]) / 2**18
    targets = np.array([*own, *aliases], np.int64)
    return targets, np.concatenate([threshold, 1 - threshold]) / max(count, 1)


def draws_like_twin(made: Tables, row: int, columns: np.ndarray, values: np.ndarray) -> None:
    """Within 2^-19 of the row, in total variation: thresholds of 18 bits are rounded to nearest."""
    count, total, chances = reference.walk_tables(columns, values, made.shape[1])
    assert (made.records.get()[row, 2], made.sums()[row]) == (count, total)
    if count:
        found = np.bincount(*drawn(made, row), chances.size)
        assert np.abs(found - chances.ravel()).sum() / 2 <= 2.0**-19 + 2.0**-30


@pytest.mark.parametrize("form", helpers.ROWS)
@pytest.mark.parametrize("name", DENSE)
def test_tables_draw_like_the_twin(device, name, form):
    made = tables(helpers.FORMATS[form](device, DENSE[name]))
    for row, values in enumerate(DENSE[name]):
        columns = np.flatnonzero(values) if form == "csr" else np.arange(len(values))
        draws_like_twin(made, row, columns, values[columns])


@pytest.mark.parametrize("form", helpers.ROWS)
def test_tables_of_slabs_and_of_columns(device, small_device, form):
    A = gallery.sparse(37, 37, 0.4).toarray()
    b = gallery.vectors(37, None, 5)
    small_device.max_allocation = 2000
    make = helpers.FORMATS[form]
    cut = make(small_device, A)
    whole = make(device, A)
    transposed = make(device, A.T)
    small_device.max_allocation = 1 << 16
    assert len(cut.slabs) > 1
    np.testing.assert_array_equal(squares(cut).to_dense(), np.square(A))
    columns = tables_of_columns(whole)
    columns.append(device.upload(b))
    for made, expected in ((tables(cut), tables(whole)), (columns, tables(transposed))):
        np.testing.assert_array_equal(made.records.get()[:37], expected.records.get())
        entries = expected.entries.get()
        np.testing.assert_array_equal(made.entries.get()[: len(entries)], entries)
    draws_like_twin(columns, 37, np.arange(37), b)


@pytest.mark.parametrize("name", COLOURS)
def test_a_shared_step_is_the_row_of_every_channel_in_the_mean(device, name):
    """Within 2^-18 of the row in total variation, as alias tables are, times the largest factor."""
    made = tables_of(device, name)
    assert made.links is not None
    links = made.links.get()
    for row in range(made.shape[0]):
        targets, chances = drawn(made, row)
        entries = links[made.records.get()[row, 0] + (targets >> 1)]
        for sign, R, bits in zip(SIGNS, SCENES[name], entries.T[1:], strict=True):
            expected = sign * R[row].astype(np.float64)
            weights = chances * bits.view(np.float32)
            step = np.bincount(entries[:, 0], weights, len(expected))
            assert np.abs(step - expected).sum() <= 2**-17 * 3 * np.abs(expected).sum()


def test_tables_are_made_once_and_live_with_their_matrices(device):
    M, *others = (Dense(device, gallery.signed(9, 9, seed)) for seed in range(4))
    made = linked([M, *others[:2]], SIGNS)
    assert made is linked([M, *others[:2]], SIGNS)
    assert made is not linked([M, *others[:2]], (1.0, 1.0, 1.0))
    assert made is not linked([M, *others[1:]], SIGNS)
    alive = weakref.ref(M)
    del M, made
    # Its tables are freed with it, at once.
    assert alive() is None


def test_tables_beyond_the_device_are_refused(small_device):
    with pytest.raises(MemoryLimitError, match=r"12.5 KiB.*4 KiB"):
        tables(Dense(small_device, gallery.signed(40, 40)))
    Rs = [CSR(small_device, scipy.sparse.csr_array(gallery.signed(18, 18, c))) for c in range(3)]
    with pytest.raises(MemoryLimitError, match=r"5.062 KiB.*4 KiB"):
        linked(Rs, SIGNS)


@pytest.mark.parametrize("form", helpers.ROWS)
def test_R_is_what_S_has_beside_the_identity(device, form):
    R = gallery.sparse(53, 53, 0.4).toarray()
    M = helpers.FORMATS[form](device, R)
    S = helpers.FORMATS[form](device, np.eye(53, dtype=np.float32) + R)
    for sign in (1.0, -1.0):
        assert rows_of_R(IdentityPlus(M, sign), "monte_carlo") == (M, sign)
    made, sign = rows_of_R(S, "monte_carlo")
    assert sign == 1.0
    np.testing.assert_allclose(made.to_dense(), R, rtol=0, atol=1e-7)
    assert rows_of_R(S, "hybrid")[0] is made


def same(found: Sums, total: np.ndarray, squared: np.ndarray) -> None:
    np.testing.assert_array_equal(found.total, total.reshape(found.total.shape))
    np.testing.assert_array_equal(found.squares, squared.reshape(found.squares.shape))


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, 5])
@pytest.mark.parametrize("name", SCENES)
def test_sums_are_those_of_the_twin_to_the_bit(shaped, name, k):
    """k right-hand sides of each channel, one column a channel in turn; 5 of 3 take 2 launches."""
    made = tables_of(shaped, name)
    lengths = Lengths.geometric(0.6, -1.0)
    b = gallery.vectors(made.shape[0], k * made.channels)
    pixels = np.arange(made.shape[0])[::-1]
    found = Walker(made, lengths, SEED).rows(shaped.upload(b), pixels, 70, stream=3)
    assert found.total.shape == b.shape
    arrays = made.records.get(), made.entries.get(), made.channels, made.links and made.links.get()
    chunks = reference.walk_rows(arrays, lengths.steps(), b, pixels, np.arange(70), SEED, 3, CHUNK)
    sums = np.add.accumulate(chunks.astype(np.float64), axis=1)[:, -1]
    same(found, *np.moveaxis(sums, -1, 0))


# Few items with a few walks each, or many with many.
@pytest.mark.slow
@pytest.mark.parametrize("copies", [1, 9])
@pytest.mark.parametrize("units", [1, 5, 1 << 18])
@pytest.mark.parametrize("name", ["positive", "alike"])
def test_no_bit_depends_on_how_it_is_launched(device, shaped, monkeypatch, name, units, copies):
    b = gallery.vectors(29, 9)
    pixels = np.arange(29)
    lengths = Lengths.geometric(0.7, -1.0)
    walker = Walker(tables_of(device, name), lengths, SEED)
    expected = walker.rows(device.upload(b), pixels, 200)
    monkeypatch.setattr("ltcl.operators.walks.MAX_LAUNCH_CHUNKS", units)
    walker = Walker(tables_of(shaped, name), lengths, SEED)
    many = np.tile(pixels, copies)
    sums = walker.rows(shaped.upload(b), many, 200)
    same(sums, expected.total[many], expected.squares[many])
    # One pixel does not see another.
    some = np.array([28, 3])
    sums = walker.rows(shaped.upload(b), some, 200)
    same(sums, expected.total[some], expected.squares[some])


@pytest.mark.parametrize("records", [100, 1 << 22])
@pytest.mark.parametrize("samples", [1000, 40_000])
@pytest.mark.parametrize("form", helpers.ROWS)
def test_walks_from_b_are_those_of_the_twin(shaped, monkeypatch, form, samples, records):
    monkeypatch.setattr("ltcl.operators.walks.MAX_LAUNCH_SAMPLES", max(records, samples // 10))
    b = gallery.vectors(53, None)
    made = tables_of_columns(helpers.FORMATS[form](shaped, EMPTY_ROWS))
    lengths = Lengths.geometric(0.6, -1.0, from_b=True)
    made.append(shaped.upload(b))
    found = Walker(made, lengths, SEED).columns(samples)
    arrays = made.records.get(), made.entries.get(), 1, None
    ends, scores = reference.walk_columns(arrays, lengths.steps(), 53, np.arange(samples), SEED)
    ends = np.where(scores == 0, 0, ends)
    scores = scores.astype(np.float64)
    np.testing.assert_allclose(found.total, np.bincount(ends, scores, 53), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.squares, np.bincount(ends, scores**2, 53), rtol=1e-12)


@pytest.mark.parametrize(("word", "block"), [
    (0, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    (0xFFFFFFFF, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
])  # fmt: skip
def test_the_twin_of_walks_draws_the_published_blocks(word, block):
    """Known answers of Philox4x32-10 in Random123, the library of the method's authors."""
    counters = np.full((1, 4), word, np.uint32)
    assert reference.philox(counters, word | word << 32)[0].tolist() == list(block)


@pytest.mark.slow
def test_entries_are_drawn_in_proportion(device):
    """Scores of a single step in a basis of pixels count where it went: eq. 25 with signs."""
    R = gallery.signed(19, 19, 3) * np.linspace(0.01, 1, 19)
    R[:, [2, 11]] = 0
    made = tables(Dense(device, R))
    walker = Walker(made, Lengths(np.ones(1), 1.0), SEED)
    for row in range(4):
        found = walker.rows(device.upload(np.eye(19)), np.array([row]), 100_000)
        counts = np.round(found.squares[0] / made.sums()[row].astype(float) ** 2)
        expected = 100_000 * np.abs(R[row]) / np.abs(R[row]).sum()
        assert counts.sum() == 100_000
        assert np.all(np.abs(counts - expected) <= 4.5 * np.sqrt(expected))
        assert np.array_equal(np.sign(found.total[0]), np.sign(R[row]))


def ring(device, n: int) -> CSR:
    """Each pixel leads to the next."""
    i = np.arange(n)
    return CSR(device, scipy.sparse.csr_array((np.ones(n), (i, (i + 1) % n)), shape=(n, n)))


@pytest.mark.parametrize("m", [0.1, 0.3, 0.45])
def test_lengths_are_those_of_eq_24(device, m):
    """No walk gets around the ring: all scores of a place are alike and count its visitors."""
    n = 192
    samples = 100_000
    q = m / (1 - m)
    walker = Walker(tables(ring(device, n)), Lengths.geometric(q, -1.0), SEED)
    sums = walker.rows(device.upload(np.eye(n)), np.array([0]), samples)
    k = np.arange(1, n)
    # eq. 24, added up from k on.
    expected = samples * q ** (k - 1)
    is_likely = expected > 10
    k = k[is_likely]
    expected = expected[is_likely]
    total = sums.total[0, k]
    squares = sums.squares[0, k]
    deviation = np.sqrt(expected * (1 - expected / samples))
    assert np.all(np.abs(total**2 / squares - expected) <= 5 * deviation + 1e-6 * samples)
    np.testing.assert_allclose(squares / total, (-1.0) ** k * samples / expected, rtol=1e-5)


@pytest.mark.parametrize("go_on", [1.0, 0.999999])
def test_no_walk_is_longer_than_its_table_of_steps(shaped, go_on):
    """All that reach the last of three steps end there: one more would read behind the table."""
    c = np.array([2.0, -3.0, 5.0])
    b = np.arange(1.0, 8.0)
    walker = Walker(tables(ring(shaped, 7)), Lengths(c, go_on), SEED)
    mean = walker.rows(shaped.upload(b), np.arange(7), 64).mean
    expected = sum(c[k] * np.roll(b, -k - 1) for k in range(3))
    np.testing.assert_allclose(mean, expected, rtol=1e-5)


def test_rounding_does_not_grow_with_the_samples(device):
    """Every sample scores 0.1: float32 sums of 64 round, float64 sums of all add nothing to it."""
    walker = Walker(tables(Dense(device, [[0.1]])), Lengths(np.ones(1)), SEED)
    found = walker.rows(device.upload(np.ones(1)), np.array([0]), 10_000_000)
    assert found.mean[0] == pytest.approx(0.1, rel=CHUNK / 2 * 2.0**-24)
    assert found.standard_error[0] <= (CHUNK * 2.0**-24) ** 0.5 * 0.1 / 10_000_000**0.5


def test_every_device_draws_the_same_bits(device):
    """Oclgrind, where it is installed, has no prefetch and no fast loads of a vector."""
    lengths = Lengths.geometric(0.6, -1.0)
    results = []
    for description in ltcl.list_devices():
        other = ltcl.open_device(description.index)
        walker = Walker(tables_of(other, "signs, empty rows"), lengths, SEED)
        b = other.upload(gallery.vectors(53, 2))
        results.append(walker.rows(b, np.arange(53), 70))
    for sums in results:
        same(sums, results[0].total, results[0].squares)
