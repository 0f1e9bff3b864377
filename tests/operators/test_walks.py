# SPDX-License-Identifier: BSD-3-Clause
"""Walks: sums to the bit those of the twin, however they are launched; draws and lengths as wanted."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.stats

from ltcl.operators import CSR, Dense
from ltcl.operators.alias import SAMPLERS, Tables, tables, tables_of_columns
from ltcl.operators.links import links
from ltcl.operators.walks import CHUNK, ESTIMATORS, Launching, Lengths, Sums, Walker, geometric, whole
from tests import gallery, reference

SEED = 0x0123456789ABCDEF
FORMATS = {"csr": lambda device, M: CSR(device, scipy.sparse.csr_array(M)), "dense": Dense}
LAUNCHINGS = [Launching(1, 1), Launching(3, 7), Launching(8, 16), Launching(32, 1)]


def _with_empty_rows() -> np.ndarray:
    R = gallery.sparse(53, 53, 0.3).toarray() / 12
    R[[0, 7, 52]] = 0
    return R


def _strong() -> np.ndarray:
    """Two rows that are full among others of one value."""
    R = np.diag(gallery.signed(1, 41)[0]) / 2
    R[[7, 40]] = gallery.signed(2, 41, 1) / 30
    return R


MATRICES = {
    "1x1": np.array([[-0.5]], np.float32),
    "no entries": np.zeros((3, 3), np.float32),
    "signs, empty rows": _with_empty_rows(),
    "strong rows": _strong().astype(np.float32),
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
}


def raw(made: Tables) -> tuple[Any, ...]:
    links = (made.links.get(),) if made.channels > 1 else ()
    return made.records.get(), made.entries.get(), made.sampler, *links


def twin_sums(
    made: Tables,
    lengths: Lengths,
    estimator: str,
    b: np.ndarray,
    pixels: np.ndarray,
    at: range,
) -> tuple[np.ndarray, np.ndarray]:
    """Sums and sums of squares, (P, k) float64, chunk by chunk as the device makes them."""
    steps = lengths.steps(estimator)
    found = reference.walk_rows(
        raw(made), steps, b, pixels, np.array(at), SEED, 3, estimator == "collision", CHUNK
    )
    found = found.astype(np.float64)
    total, squares = np.zeros((len(pixels), b.shape[1])), np.zeros((len(pixels), b.shape[1]))
    for chunk in found.swapaxes(0, 1):
        total = total + (chunk[..., 0] + chunk[..., 1])
        squares = squares + (chunk[..., 2] + chunk[..., 3])
    return total, squares


def same(found: Sums, total: np.ndarray, squares: np.ndarray) -> None:
    np.testing.assert_array_equal(found.total, total.reshape(found.total.shape))
    np.testing.assert_array_equal(found.squares, squares.reshape(found.squares.shape))


@pytest.mark.parametrize("k", [None, 1, 3, 5])
@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("name", MATRICES)
def test_sums_are_those_of_the_twin_to_the_bit(device, name, estimator, sampler, k):
    R = MATRICES[name]
    made, lengths = tables(FORMATS["csr"](device, R), sampler), geometric(0.6, -1.0)
    b, pixels = gallery.vectors(len(R), k), np.arange(len(R))[::-1]
    found = Walker(made, lengths, estimator, SEED).rows(device.upload(b), pixels, 10, 70, stream=3)
    assert found.total.shape == b.shape
    same(found, *twin_sums(made, lengths, estimator, b.reshape(len(R), -1), pixels, range(10, 80)))


@pytest.mark.parametrize("k", [1, 3, 5])
@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("name", COLOURS)
def test_walks_of_three_channels_are_those_of_the_twin_to_the_bit(device, name, estimator, sampler, k):
    """k right-hand sides of each, one column a channel in turn; `k` of 5 takes two launches."""
    Rs = [FORMATS["csr" if c else "dense"](device, R) for c, R in enumerate(COLOURS[name])]
    made, lengths, n = links(Rs, (1.0, 1.0, -1.0), sampler), geometric(0.6, -1.0), len(COLOURS[name][0])
    b, pixels = gallery.vectors(n, 3 * k), np.arange(n)[::-1]
    found = Walker(made, lengths, estimator, SEED).rows(device.upload(b), pixels, 10, 70, stream=3)
    same(found, *twin_sums(made, lengths, estimator, b, pixels, range(10, 80)))


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("form", FORMATS)
def test_equal_channels_walk_as_one_does_to_the_bit(device, form, sampler):
    R, b = MATRICES["signs, empty rows"], gallery.vectors(53, 2)
    Rs, pixels = [FORMATS[form](device, R) for _ in range(3)], np.arange(53)
    walkers = [
        Walker(made, geometric(0.6, -1.0), "collision", SEED)
        for made in (tables(Rs[0], sampler), links(Rs, (1.0, 1.0, 1.0), sampler))
    ]
    alone, together = (
        walker.rows(device.upload(x), pixels, 0, 100)
        for walker, x in zip(walkers, (b, b.repeat(3, axis=1)), strict=True)
    )
    same(together, alone.total.repeat(3, axis=1), alone.squares.repeat(3, axis=1))


@pytest.mark.parametrize("lengths", [geometric(0.9, 1.0), whole(np.array([1.5, -2.0, 0.0, 0.25]))])
def test_dense_rows_and_other_lengths_too(device, lengths):
    R = MATRICES["signs, empty rows"]
    made, b, pixels = tables(Dense(device, R)), gallery.vectors(53, 2), np.array([5, 5, 7, 50])
    found = Walker(made, lengths, "collision", SEED).rows(device.upload(b), pixels, 0, 130, stream=3)
    same(found, *twin_sums(made, lengths, "collision", b, pixels, range(130)))


@pytest.mark.parametrize("launching", LAUNCHINGS)
@pytest.mark.parametrize("units", [1, 5, 1 << 18])
def test_no_bit_depends_on_how_it_is_launched(device, monkeypatch, units, launching):
    R, b = MATRICES["positive"], gallery.vectors(29, 11)
    made, pixels = tables(Dense(device, R)), np.arange(29)
    wanted = Walker(made, geometric(0.7, -1.0), "collision", SEED).rows(device.upload(b), pixels, 0, 200)
    monkeypatch.setattr("ltcl.operators.walks._UNITS", units)
    walker = Walker(made, geometric(0.7, -1.0), "collision", SEED, launching)
    same(walker.rows(device.upload(b), pixels, 0, 200), wanted.total, wanted.squares)
    some = walker.rows(device.upload(b), np.array([28, 3]), 0, 200)  # one pixel does not see another
    same(some, wanted.total[[28, 3]], wanted.squares[[28, 3]])


@pytest.mark.parametrize("launching", LAUNCHINGS)
def test_nor_does_a_bit_of_walks_of_three_channels(device, monkeypatch, launching):
    Rs, b = [Dense(device, R) for R in COLOURS["alike"]], gallery.vectors(29, 6)
    made, pixels, lengths = links(Rs, (1.0, 1.0, 1.0)), np.arange(29), geometric(0.7, -1.0)
    wanted = Walker(made, lengths, "collision", SEED).rows(device.upload(b), pixels, 0, 200)
    monkeypatch.setattr("ltcl.operators.walks._UNITS", 5)
    walker = Walker(made, lengths, "collision", SEED, launching)
    same(walker.rows(device.upload(b), pixels, 0, 200), wanted.total, wanted.squares)


@pytest.mark.parametrize("launching", LAUNCHINGS)
@pytest.mark.parametrize("form", FORMATS)
def test_walks_from_b_are_those_of_the_twin(device, form, launching):
    R, b = MATRICES["signs, empty rows"], gallery.vectors(53, None)
    made, lengths = tables_of_columns(FORMATS[form](device, R)), geometric(0.6, -1.0)
    made.append(device.upload(b))
    found = Walker(made, lengths, "endpoint", SEED, launching).columns(7, 1000)
    steps = lengths.after_start().steps("endpoint")
    ends, scores = reference.walk_columns(raw(made), steps, 53, np.arange(7, 1007), SEED)
    scores, ends = scores.astype(np.float64), np.where(scores == 0, 0, ends)
    same(found, np.bincount(ends, scores, 53), np.bincount(ends, scores**2, 53))


def chi_square(counts: np.ndarray, probabilities: np.ndarray) -> float:
    """The p-value of counts; what is never expected must never come."""
    assert counts[probabilities == 0].sum() == 0
    seen = probabilities > 0
    expected = counts.sum() * probabilities[seen] / probabilities.sum()
    return float(scipy.stats.chisquare(counts[seen], expected).pvalue)


@pytest.mark.parametrize("sampler", ["alias", "cdf"])
def test_entries_are_drawn_in_proportion(device, sampler):
    """Scores of a single step in a basis of pixels count where it went: eq. 25 with signs."""
    R = gallery.signed(4, 19, 3) * np.linspace(0.01, 1, 19)
    R[:, [2, 11]] = 0
    made = tables(Dense(device, R), sampler)
    basis = np.eye(19, dtype=np.float32)
    walker = Walker(made, whole(np.ones(1)), "endpoint", SEED)
    for row in range(4):
        found = walker.rows(device.upload(basis), np.array([row]), 0, 100_000)
        drawn = np.round(found.squares[0] / made.sums()[row].astype(float) ** 2)
        assert drawn.sum() == 100_000
        assert chi_square(drawn, np.abs(R[row]).astype(float)) > 1e-3
        assert np.array_equal(np.sign(found.total[0]), np.sign(R[row]))


def test_uniform_draws_are_uniform(device):
    R = np.abs(gallery.signed(1, 23)) + np.float32(0.1)
    walker = Walker(tables(Dense(device, R), "uniform"), whole(np.ones(1)), "endpoint", SEED)
    found = walker.rows(device.upload(np.eye(23)), np.array([0]), 0, 100_000)
    drawn = np.round(found.total[0] / (23.0 * R[0].astype(float)))
    assert drawn.sum() == 100_000
    assert chi_square(drawn, np.ones(23)) > 1e-3


@pytest.mark.parametrize("m", [0.1, 0.3, 0.45])
def test_lengths_are_those_of_eq_24(device, m):
    """On a ring of pixels, each of which leads to the next, where a walk ends tells how long it was."""
    n, samples = 64, 100_000
    ring = scipy.sparse.csr_array((np.ones(n), ((np.arange(n)), (np.arange(n) + 1) % n)), shape=(n, n))
    lengths = geometric(m / (1 - m), -1.0)
    walker = Walker(tables(CSR(device, ring)), lengths, "endpoint", SEED)
    found = walker.rows(device.upload(np.eye(n)), np.array([0]), 0, samples)
    k = np.arange(1, n)
    p = (1 - 2 * m) / m * (m / (1 - m)) ** k  # eq. 24
    counts = np.abs(found.total[0][1:]) * p  # an endpoint scores (-1)^k / p(k)
    np.testing.assert_array_equal(np.sign(found.total[0][1:3]), [-1, 1])
    usual = samples * p > 10  # what is rarer is counted together
    together = np.append(counts[usual], samples - counts[usual].sum())
    assert chi_square(np.round(together), np.append(p[usual], 1 - p[usual].sum())) > 1e-3


def test_lengths_sum_to_one():
    for q in (0.0, 0.25, 0.9):
        lengths = geometric(q, 1.0)
        worth = np.ascontiguousarray(lengths.steps("endpoint")[:, 0]).view(np.float32).astype(float)
        assert np.sum(1 / worth) == pytest.approx(1.0, abs=1e-6)


def test_sums_tell_their_error():
    values = np.random.default_rng(0).normal(3.0, 2.0, (1000, 5))
    found = Sums(1000, values.sum(axis=0), (values**2).sum(axis=0))
    np.testing.assert_allclose(found.mean, values.mean(axis=0))
    np.testing.assert_allclose(found.standard_error, values.std(axis=0, ddof=1) / 1000**0.5)
    assert np.all(np.isinf(Sums(1, values[0], values[0] ** 2).standard_error))


def test_no_digits_are_lost_in_ten_million_samples(device):
    """Every sample scores 0.1 exactly alike: the mean is what one scores, to the last digit of float64."""
    R = np.array([[0.1]], np.float32)
    walker = Walker(tables(Dense(device, R)), whole(np.ones(1)), "endpoint", SEED)
    found = walker.rows(device.upload(np.ones(1)), np.array([0]), 0, 10_000_000)
    assert found.mean[0] == pytest.approx(float(R[0, 0]), rel=1e-13)
    # Squares are rounded to float32: a spread below sqrt(2^-24) of the mean looks as large as that.
    assert found.standard_error[0] <= 2.0**-12 * 0.1 / 10_000_000**0.5


@pytest.mark.parametrize("m", [0.2, 0.4999])
def test_no_launch_is_long(device, monkeypatch, m):
    """By steps of its walks in the mean, for each compute unit, whatever the samples or their length."""
    R = gallery.bounces(5, 0.1)
    lengths, launched = geometric(m / (1 - m), -1.0), []
    assert lengths.mean == pytest.approx((1 - m) / (1 - 2 * m), rel=1e-3)
    monkeypatch.setattr("ltcl.operators.walks._STEPS", 1 << 12)
    walker = Walker(tables(Dense(device, R)), lengths, "collision", SEED)
    wanted = walker.rows(device.upload(np.ones(5)), np.arange(5), 0, 640)
    monkeypatch.setattr(Walker, "_launch", _counting(launched, Walker._launch))
    same(walker.rows(device.upload(np.ones(5)), np.arange(5), 0, 640), wanted.total, wanted.squares)
    longest = max(launched) * CHUNK * lengths.mean
    assert longest <= max((1 << 12) * device.compute_units, CHUNK * lengths.mean)
    assert sum(launched) == 50


def _counting(launched, launch):
    def spy(self, name, estimator, width, units, *rest):
        launched.append(units)
        launch(self, name, estimator, width, units, *rest)

    return spy


def test_doubt_is_how_far_the_sum_of_squares_is_off(device):
    """Relative standard deviation of it over many runs, of skewed scores."""
    R = gallery.bounces(17, 0.6)
    b = np.where(np.arange(17) == 3, 1.0, 0.0)
    walks = [Walker(tables(Dense(device, R)), geometric(0.6, -1.0), "collision", s) for s in range(60)]
    found = [walk.rows(device.upload(b), np.arange(17), 0, 64 * CHUNK) for walk in walks]
    sums = np.stack([one.squares for one in found])
    spread = sums.std(axis=0, ddof=1) / sums.mean(axis=0)
    told = np.sqrt(np.mean([one.doubt**2 for one in found], axis=0))
    assert np.sqrt(np.mean((told / spread) ** 2)) == pytest.approx(1.0, abs=0.25)
    assert np.isinf(walks[0].rows(device.upload(b), np.arange(17), 0, CHUNK).doubt).all()
