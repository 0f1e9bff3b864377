# SPDX-License-Identifier: BSD-3-Clause
"""Which basis is taken, with times as a model has them: what a clock says is tested nowhere."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.compression import choice, kinds
from ltcl.compression.cores import Core
from ltcl.operators import Compressed, Operator

SUM = f"db2{kinds.SUM}"
BASES = ["db2", "haar", kinds.PIXELS, SUM]


@pytest.fixture
def modelled(monkeypatch: pytest.MonkeyPatch) -> None:
    """A product takes a unit on coefficients alone, and five where pixels are transformed first."""

    def seconds(R: Operator, core: Core) -> float:
        return 1e-4 if isinstance(R, Compressed) and R.two_sided else 5e-4

    monkeypatch.setattr(choice, "seconds", seconds)


def sharp(n: int) -> ltcl.Transport:
    """A corner, where a few pixels also light up one another."""
    scene = ltcl.scenes.dihedral(n, albedo=0.6)
    (T,) = scene.matrices()
    rng = np.random.default_rng(0)
    linked = rng.random(T.shape) < 0.005
    T += 0.05 * linked * rng.random(T.shape) * scene.first_bounce
    return ltcl.Transport(T, scene.grid, first_bounce=scene.first_bounce)


@pytest.mark.usefixtures("modelled")
def test_sharp_light_is_written_as_a_sum_though_that_takes_longer():
    (told,) = ltcl.compress(sharp(16), 0.02, basis=BASES).compression.channels
    sizes = {trial.basis: trial.nbytes for trial in told.trials}
    assert 5 * sizes[SUM] < sizes["db2"]
    assert told.basis == SUM


@pytest.mark.usefixtures("modelled")
@pytest.mark.parametrize("rtol", [0.1, 0.01])
@pytest.mark.parametrize(
    "make",
    [
        lambda: ltcl.scenes.dihedral(16, albedo=0.8).transport(),
        lambda: ltcl.scenes.box(8, sides=3, albedo=0.7).transport(),
    ],
)
def test_smooth_light_is_written_in_wavelets_on_both_sides(make, rtol):
    C = ltcl.compress(make(), rtol)
    (told,) = C.compression.channels
    assert told.basis in ("db2", "haar", "db4")
    assert {SUM, kinds.PIXELS} <= {trial.basis for trial in told.trials}
    R = C.systems[0].R
    assert isinstance(R, Compressed)
    assert R.two_sided


def test_trials_are_of_the_coefficients_that_are_handed_out():
    T = ltcl.scenes.dihedral(16, albedo=0.6).transport()
    (told,) = ltcl.compress(T, 0.3, basis="db2").compression.channels
    (trial,) = told.trials
    rows = T.shape[0]
    assert trial.kept * rows < 100
    assert trial.nbytes < 4 * rows  # what pointers of all rows would take
