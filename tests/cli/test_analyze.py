# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltcl import scenes, store

from .conftest import Program


def test_json_agrees_with_the_eigenvalues(program: Program, transport: Path) -> None:
    (entry,) = program("analyze", transport, "--json").json
    A = scenes.dihedral(5, albedo=0.6).A
    assert isinstance(A, np.ndarray)
    m = float(np.abs(np.linalg.eigvals(A)).max())
    assert entry["channels"][0]["spectral_radius"] == pytest.approx(m / (1 - m), rel=1e-2)
    assert entry["channels"][0]["products"]["jacobi"] > 0


def test_table_says_what_diverges(program: Program, tmp_path: Path) -> None:
    path = tmp_path / "closed.npz"
    store.save(path, scenes.box(3, albedo=0.8).transport())
    outcome = program("analyze", path)
    assert outcome.code == 0
    assert outcome.out.count(" diverges") == 2  # jacobi and neumann


def test_colour_has_three_rows(program: Program, colour_transport: Path) -> None:
    outcome = program("analyze", colour_transport)
    assert all(colour in outcome.out for colour in ("red", "green", "blue"))


def test_refusals(program: Program, dark_transport: Path, tmp_path: Path) -> None:
    program("analyze", dark_transport).refused("zero or negative at 2 of 6", "--on-dark mask")
    assert program("analyze", dark_transport, "--on-dark", "mask").code == 0
    path = tmp_path / "T.npy"
    np.save(path, np.eye(6))
    program("analyze", path).refused("--grid HxW")
    program("analyze", path, "--grid", "2x4").refused("h * w must be 6")
    program("analyze", path, "--grid", "2x3", "--rtol", "2").refused("rtol is 2.0")
    assert program("analyze", path, "--grid", "2x3").code == 0


def test_everything_is_in_the_tables_and_in_json(program: Program, transport: Path) -> None:
    outcome = program("analyze", transport)
    assert outcome.code == 0
    for part in (
        "eq. 16",
        "cancel bounces",
        "between",
        "collatz-wielandt",
        "no forecast",
        "gauss_seidel",
        "richardson",
        "reciprocity defect",
        "0 %",
    ):
        assert part in outcome.out
    (channel,) = program("analyze", transport, "--json").json[0]["channels"]
    assert channel["reciprocity_defect"] < 1e-5
    assert 0 < channel["energy"]["bounce_highest"] < 0.6  # the albedo
    assert channel["certificates"]["chebyshev"] == "free bounds"
    assert [terms["n"] for terms in channel["series"]] == [1, 2, 4, 8, 16]
    lower, upper = channel["spectral_radius_bounds"]
    assert lower <= channel["spectral_radius"] <= upper


def test_plot(program: Program, transport: Path, colour_transport: Path, tmp_path: Path) -> None:
    assert program("analyze", transport, colour_transport, "--plot", tmp_path / "a.png").code == 0
    assert (tmp_path / "a.png").stat().st_size > 10_000
    program("analyze", transport, "--plot", tmp_path / "a.xyz").refused("plots are")


def test_an_estimated_first_bounce(program: Program, transport: Path) -> None:
    (entry,) = program("analyze", transport, "--first-bounce", "estimate", "--json").json
    (exact,) = program("analyze", transport, "--first-bounce", "exact", "--json").json
    found, wanted = (e["channels"][0]["spectral_radius"] for e in (entry, exact))
    assert found == pytest.approx(wanted, rel=0.1)
