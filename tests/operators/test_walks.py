# SPDX-License-Identifier: BSD-3-Clause
"""Tables and walks: to the bit those of the twin, however they are launched; draws and lengths as wanted."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
import scipy.stats

import ltcl
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import CSR, Dense, Host, IdentityPlus
from ltcl.operators.walks import (
    CHUNK,
    ESTIMATORS,
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

SEED = 0x0123456789ABCDEF
TINY = float(np.finfo(np.float32).tiny)
FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
LAUNCHINGS = [(1, 1), (1, 64), (3, 7), (8, 16), (32, 1), (32, 32)]  # GPUs take groups
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


def _with_empty_rows() -> np.ndarray:
    R = gallery.sparse(53, 53, 0.3).toarray() / 12
    R[[0, 7, 52]] = 0
    return R


def _strong() -> np.ndarray:
    """Two rows that are full among others of one value."""
    R = np.diag(gallery.signed(1, 41)[0]) / 2
    R[[7, 40]] = gallery.signed(2, 41, 1) / 30
    return R.astype(np.float32)


MATRICES = {
    "1x1": np.array([[-0.5]], np.float32),
    "no entries": np.zeros((3, 3), np.float32),
    "signs, empty rows": _with_empty_rows(),
    "strong rows": _strong(),
    "positive": gallery.bounces(29, 0.6),
}
# Three R of colour channels: signs, places and empty rows of their own, and one for which all are empty.
COLOURS = {
    "1x1": [np.array([[value]], np.float32) for value in (0.5, -0.25, 0.0)],
    "no entries": [MATRICES["no entries"]] * 3,
    "apart": [
        MATRICES["signs, empty rows"],
        gallery.sparse(53, 53, 0.2, 1).toarray() / 9,
        gallery.sparse(53, 53, 0.1, 2).toarray() / 9,
    ],
    "alike": [gallery.bounces(29, rho) for rho in (0.6, 0.3, 0.5)],
    "far apart": [gallery.signed(9, 9, seed) * scale for seed, scale in enumerate((1e-20, 0.1, 0.1))],
}
SIGNS = (1.0, 1.0, -1.0)


def colours(device, name: str) -> list[CSR | Dense]:
    return [FORMATS["csr" if c else "dense"](device, R) for c, R in enumerate(COLOURS[name])]


def drawn(made: Tables, row: int) -> tuple[np.ndarray, np.ndarray]:
    """Column with sign, and chance, of what an alias table draws."""
    start, _, count, _ = made.records.get()[row].tolist()
    entries = made.entries.get()[start : start + count].tolist()
    own, threshold = [e >> 23 & 0x7FFFFF for e in entries], np.array([e >> 46 for e in entries]) / 2**18
    targets = np.array([*own, *(e & 0x7FFFFF for e in entries)], np.int64)
    return targets, np.concatenate([threshold, 1 - threshold]) / max(count, 1)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("name", DENSE)
def test_tables_are_those_of_the_twin(device, name, form):
    """And what they draw is within 2^-18 of the row, in total variation, with its signs."""
    A = DENSE[name]
    made = tables(FORMATS[form](device, A))
    records, entries = made.records.get(), made.entries.get()
    for i, values in enumerate(A):
        columns = np.flatnonzero(values) if form == "csr" else np.arange(len(values))
        count, total, table = reference.alias_rows(columns, values[columns])
        assert (records[i, 2], made.sums()[i]) == (count, total)
        if table:
            start = int(records[i, 0]) | int(records[i, 1]) << 32
            assert entries[start : start + len(columns)].tolist() == table
        exact = np.abs(values.astype(np.float64))
        if exact.sum() >= TINY:
            targets, chances = drawn(made, i)
            found = np.bincount(targets, chances, 2 * len(values)).reshape(-1, 2)
            wanted = np.where([values > 0, values < 0], exact / exact.sum(), 0.0).T
            assert np.abs(found - wanted).sum() / 2 <= 2.0**-18


def test_slabs_give_the_same_tables(device, small_device):
    A = gallery.sparse(53, 53, 0.3)
    small_device.max_allocation = 3000
    sparse, dense = CSR(small_device, A), Dense(small_device, A.toarray())
    small_device.max_allocation = 1 << 16
    for cut, whole in ((sparse, CSR(device, A)), (dense, Dense(device, A.toarray()))):
        assert len(cut.slabs) > 1
        assert tables(cut).entries.get().tolist() == tables(whole).entries.get().tolist()
        assert tables(cut).records.get().tolist() == tables(whole).records.get().tolist()
        np.testing.assert_array_equal(squares(cut).to_dense(), np.square(A.toarray()))


def test_columns_are_the_rows_of_the_transpose(device):
    A = gallery.sparse(37, 37, 0.4)
    for M, turned in (
        (CSR(device, A), CSR(device, A.T)),
        (Dense(device, A.toarray()), Dense(device, A.toarray().T)),
    ):
        made, wanted = tables_of_columns(M), tables(turned)
        assert made.records.get()[:37].tolist() == wanted.records.get().tolist()
        assert made.entries.get()[:-37].tolist() == wanted.entries.get().tolist()
        b = gallery.vectors(37, None, 5)
        made.append(device.upload(b))
        count, total, table = reference.alias_rows(np.arange(37), b)
        assert (made.records.get()[37, 2], made.sums()[37]) == (count, total)
        assert made.entries.get()[-37:].tolist() == table


@pytest.mark.parametrize("name", COLOURS)
def test_a_shared_step_is_the_row_of_every_channel_in_the_mean(device, name):
    """Within 2^-18 of the row in total variation, as alias tables are, times the largest factor."""
    made = linked(colours(device, name), SIGNS)
    assert made.links is not None
    links = made.links.get()
    for row in range(made.shape[0]):
        targets, chances = drawn(made, row)
        entries = links[made.records.get()[row, 0] + (targets >> 1)]
        for sign, R, bits in zip(SIGNS, COLOURS[name], entries.T[1:], strict=True):
            wanted = sign * R[row].astype(np.float64)
            found = np.bincount(entries[:, 0], chances * bits.view(np.float32), len(wanted))
            assert np.abs(found - wanted).sum() <= 2**-17 * 3 * np.abs(wanted).sum()


def test_tables_are_made_once_and_live_with_their_matrix(device):
    M, *others = (Dense(device, gallery.signed(9, 9, seed)) for seed in range(4))
    assert tables(M) is tables(M)
    assert tables_of_columns(M) is tables_of_columns(M)
    assert tables(M).nbytes == 9 * 9 * 8 + 9 * 16
    made = linked([M, *others[:2]], SIGNS)
    assert made is linked([M, *others[:2]], SIGNS)
    assert made is not linked([M, *others[:2]], (1.0, 1.0, 1.0))
    assert made is not linked([M, *others[:2]], SIGNS, "uniform")
    assert linked([M, *others[1:]], SIGNS).others == tuple(others[1:])
    assert made.nbytes == 9 * 9 * 24 + 9 * 16


def test_what_no_table_can_hold_is_refused(device, small_device):
    wide = scipy.sparse.csr_array((np.ones(1), ([0], [1 << 22])), shape=(1, (1 << 22) + 1))
    with pytest.raises(InputError, match=r"R.*4194305.*4194304"):
        tables(CSR(device, wide))
    with pytest.raises(InputError, match=r"R.*row 1.*float32") as caught:
        tables(Dense(device, [[1.0, 1.0], [3e38, -3e38]]))
    assert "\n" not in str(caught.value)
    with pytest.raises(MemoryLimitError, match=r"12.5 KiB.*4 KiB"):
        tables(Dense(small_device, gallery.signed(40, 40)))
    with pytest.raises(MemoryLimitError, match=r"5.062 KiB.*4 KiB"):
        linked(
            [CSR(small_device, scipy.sparse.csr_array(gallery.signed(18, 18, c))) for c in range(3)], SIGNS
        )


@pytest.mark.parametrize("form", FORMATS)
def test_R_is_what_S_has_beside_the_identity(device, form):
    R = gallery.sparse(53, 53, 0.4).toarray()
    M = FORMATS[form](device, R)
    assert rows_of_R(IdentityPlus(M), "monte_carlo") == (M, 1.0)
    assert rows_of_R(IdentityPlus(M, -1), "monte_carlo") == (M, -1.0)
    S = FORMATS[form](device, np.eye(53, dtype=np.float32) + R)
    made, sign = rows_of_R(S, "monte_carlo")
    assert sign == 1.0
    np.testing.assert_allclose(made.to_dense(), R, rtol=0, atol=1e-7)
    assert rows_of_R(S, "hybrid")[0] is made
    with pytest.raises(InputError, match=r"hybrid.*Host"):
        rows_of_R(IdentityPlus(Host(device, scipy.sparse.linalg.aslinearoperator(R))), "hybrid")


def twin_sums(
    made: Tables, lengths: Lengths, estimator: str, b: np.ndarray, pixels: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums and sums of squares, (P, k) float64, chunk by chunk as the device makes them."""
    links = None if made.links is None else made.links.get()
    raw = made.records.get(), made.entries.get(), made.channels, links
    collision = estimator == "collision"
    which = np.arange(samples)
    found = reference.walk_rows(raw, lengths.steps(estimator), b, pixels, which, SEED, 3, collision, CHUNK)
    total, squared = np.zeros((2, len(pixels), b.shape[1]))
    for chunk in found.astype(np.float64).swapaxes(0, 1):
        total = total + (chunk[..., 0] + chunk[..., 1])
        squared = squared + (chunk[..., 2] + chunk[..., 3])
    return total, squared


def same(found: Sums, total: np.ndarray, squared: np.ndarray) -> None:
    np.testing.assert_array_equal(found.total, total.reshape(found.total.shape))
    np.testing.assert_array_equal(found.squares, squared.reshape(found.squares.shape))


@pytest.mark.parametrize("k", [None, 1, 5])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("name", [*MATRICES, "uniform"])
def test_sums_are_those_of_the_twin_to_the_bit(device, name, estimator, k):
    R = MATRICES.get(name, MATRICES["signs, empty rows"])
    M, lengths = FORMATS["csr"](device, R), Lengths.geometric(0.6, -1.0)
    made = linked([M], [1.0], "uniform") if name == "uniform" else tables(M)
    b, pixels = gallery.vectors(len(R), k), np.arange(len(R))[::-1]
    found = Walker(made, lengths, estimator, SEED).rows(device.upload(b), pixels, 70, stream=3)
    assert found.total.shape == b.shape
    same(found, *twin_sums(made, lengths, estimator, b.reshape(len(R), -1), pixels, 70))


@pytest.mark.parametrize("k", [1, 5])
@pytest.mark.parametrize("sampler", ["alias", "uniform"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("name", COLOURS)
def test_walks_of_three_channels_are_those_of_the_twin_to_the_bit(device, name, estimator, sampler, k):
    """k right-hand sides of each, one column a channel in turn; `k` of 5 takes two launches."""
    made, n = linked(colours(device, name), SIGNS, sampler), len(COLOURS[name][0])
    lengths, b, pixels = Lengths.geometric(0.6, -1.0), gallery.vectors(n, 3 * k), np.arange(n)[::-1]
    found = Walker(made, lengths, estimator, SEED).rows(device.upload(b), pixels, 70, stream=3)
    same(found, *twin_sums(made, lengths, estimator, b, pixels, 70))


@pytest.mark.parametrize("launching", LAUNCHINGS)
@pytest.mark.parametrize("units", [1, 5, 1 << 18])
@pytest.mark.parametrize("channels", [1, 3])
def test_no_bit_depends_on_how_it_is_launched(device, monkeypatch, channels, units, launching):
    Rs = [Dense(device, R) for R in COLOURS["alike"]]
    made: Tables = tables(Rs[0]) if channels == 1 else linked(Rs, SIGNS)
    b, pixels, lengths = device.upload(gallery.vectors(29, 9)), np.arange(29), Lengths.geometric(0.7, -1.0)
    wanted = Walker(made, lengths, "collision", SEED).rows(b, pixels, 200)
    monkeypatch.setattr("ltcl.operators.walks._UNITS", units)
    walker = Walker(made, lengths, "collision", SEED, launching=launching)
    same(walker.rows(b, pixels, 200), wanted.total, wanted.squares)
    some = walker.rows(b, np.array([28, 3]), 200)  # one pixel does not see another
    same(some, wanted.total[[28, 3]], wanted.squares[[28, 3]])


@pytest.mark.parametrize("launching", LAUNCHINGS)
@pytest.mark.parametrize("form", FORMATS)
def test_walks_from_b_are_those_of_the_twin(device, form, launching):
    b, made = (
        gallery.vectors(53, None),
        tables_of_columns(FORMATS[form](device, MATRICES["signs, empty rows"])),
    )
    lengths = Lengths(Lengths.geometric(0.6, -1.0).coefficients, 0.6, from_b=True)
    made.append(device.upload(b))
    found = Walker(made, lengths, "endpoint", SEED, launching=launching).columns(1000)
    raw = made.records.get(), made.entries.get(), 1, None
    ends, scores = reference.walk_columns(raw, lengths.steps("endpoint"), 53, np.arange(1000), SEED)
    scores, ends = scores.astype(np.float64), np.where(scores == 0, 0, ends)
    same(found, np.bincount(ends, scores, 53), np.bincount(ends, scores**2, 53))


def chi_square(counts: np.ndarray, probabilities: np.ndarray) -> float:
    """The p-value of counts; what is never expected must never come."""
    assert counts[probabilities == 0].sum() == 0
    seen = probabilities > 0
    expected = counts.sum() * probabilities[seen] / probabilities.sum()
    return float(scipy.stats.chisquare(counts[seen], expected).pvalue)


def test_entries_are_drawn_in_proportion(device):
    """Scores of a single step in a basis of pixels count where it went: eq. 25 with signs."""
    R = gallery.signed(19, 19, 3) * np.linspace(0.01, 1, 19)
    R[:, [2, 11]] = 0
    made = tables(Dense(device, R))
    walker = Walker(made, Lengths(np.ones(1), 1.0), "endpoint", SEED)
    for row in range(4):
        found = walker.rows(device.upload(np.eye(19)), np.array([row]), 100_000)
        drawn = np.round(found.squares[0] / made.sums()[row].astype(float) ** 2)
        assert drawn.sum() == 100_000
        assert chi_square(drawn, np.abs(R[row]).astype(float)) > 1e-3
        assert np.array_equal(np.sign(found.total[0]), np.sign(R[row]))


def ring(device, n: int) -> CSR:
    """Each pixel leads to the next."""
    i = np.arange(n)
    return CSR(device, scipy.sparse.csr_array((np.ones(n), (i, (i + 1) % n)), shape=(n, n)))


@pytest.mark.parametrize("m", [0.1, 0.3, 0.45])
def test_lengths_are_those_of_eq_24(device, m):
    """On a ring of pixels where a walk ends tells how long it was."""
    n, samples = 64, 100_000
    walker = Walker(tables(ring(device, n)), Lengths.geometric(m / (1 - m), -1.0), "endpoint", SEED)
    found = walker.rows(device.upload(np.eye(n)), np.array([0]), samples)
    k = np.arange(1, n)
    p = (1 - 2 * m) / m * (m / (1 - m)) ** k  # eq. 24
    counts = np.abs(found.total[0][1:]) * p  # an endpoint scores (-1)^k / p(k)
    np.testing.assert_array_equal(np.sign(found.total[0][1:3]), [-1, 1])
    usual = samples * p > 10  # what is rarer is counted together
    together = np.append(counts[usual], samples - counts[usual].sum())
    assert chi_square(np.round(together), np.append(p[usual], 1 - p[usual].sum())) > 1e-3


@pytest.mark.parametrize("launching", LAUNCHINGS)
@pytest.mark.parametrize("go_on", [1.0, 0.999999])
def test_no_walk_is_longer_than_its_table_of_steps(device, launching, go_on):
    """All that reach the last of three steps end there: one more would read behind the table."""
    c, b = np.array([2.0, -3.0, 5.0]), np.arange(1.0, 8.0)
    endpoint, collision = (
        Walker(tables(ring(device, 7)), Lengths(c, go_on), estimator, SEED, launching=launching)
        .rows(device.upload(b), np.arange(7), 64)
        .mean
        for estimator in ("endpoint", "collision")
    )
    np.testing.assert_allclose(endpoint, 5.0 * np.roll(b, -3), rtol=1e-5)
    wanted = sum(c[k] * np.roll(b, -k - 1) for k in range(3))
    np.testing.assert_allclose(collision, wanted, rtol=1e-5)


def test_no_digits_are_lost_in_ten_million_samples(device):
    """Every sample scores 0.1 exactly alike: the mean is what one scores, to the last digit of float64."""
    R = np.array([[0.1]], np.float32)
    walker = Walker(tables(Dense(device, R)), Lengths(np.ones(1)), "endpoint", SEED)
    found = walker.rows(device.upload(np.ones(1)), np.array([0]), 10_000_000)
    assert found.mean[0] == pytest.approx(float(R[0, 0]), rel=1e-13)
    # Squares are rounded to float32: a spread below sqrt(2^-24) of the mean looks as large as that.
    assert found.standard_error[0] <= 2.0**-12 * 0.1 / 10_000_000**0.5


def test_every_device_draws_the_same_bits(device):
    """Oclgrind, where it is installed, has no prefetch and no fast loads of a vector."""
    R, b = MATRICES["signs, empty rows"], gallery.vectors(53, 2)
    found = []
    for description in ltcl.list_devices():
        other = ltcl.open_device(description.index)
        walker = Walker(tables(Dense(other, R)), Lengths.geometric(0.6, -1.0), "collision", SEED)
        found.append(walker.rows(other.upload(b), np.arange(53), 70))
    for one in found:
        same(one, found[0].total, found[0].squares)
