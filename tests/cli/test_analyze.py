# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl analyze`: numbers against eigenvalues, tables, refusals."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl import scenes


def test_json_agrees_with_the_eigenvalues(program, transport):
    A = np.asarray(scenes.dihedral(5, albedo=0.6).A)
    m = float(np.abs(np.linalg.eigvals(A)).max())
    for first_bounce, rel in (("exact", 1e-2), ("estimate", 0.1)):
        (entry,) = program("analyze", transport, "--first-bounce", first_bounce, "--json").json
        (channel,) = entry["channels"]
        assert channel["spectral_radius"] == pytest.approx(m / (1 - m), rel=rel)
        lower, upper = channel["spectral_radius_bounds"]
        assert lower <= channel["spectral_radius"] <= upper
        assert channel["products"]["jacobi"] > 0


def test_the_tables_show_all_channels_and_what_diverges(program, colour_transport, tmp_path):
    ltcl.save(tmp_path / "closed.npz", scenes.box(3, albedo=0.8).transport())
    outcome = program("analyze", colour_transport, tmp_path / "closed.npz", "--plot", tmp_path / "a.png")
    assert outcome.code == 0, outcome.err
    assert (tmp_path / "a.png").stat().st_size > 10_000
    assert outcome.out.count(" diverges") >= 2  # jacobi and neumann
    parts = (
        "red",
        "green",
        "blue",
        "grey",
        "rho(R)",
        "collatz-wielandt",
        "reciprocity",
    )
    assert all(part in outcome.out for part in parts)


def test_refusals(program, tmp_path):
    np.save(tmp_path / "T.npy", np.diag([1.0, 1, 0, 1, 0, 1]))
    common = ["analyze", tmp_path / "T.npy"]
    program(*common).refused("T.npy", "(--grid)")
    program(*common, "--grid", "2x4").refused("grid is 2 x 4", "6", "(--grid)")
    program(*common, "--grid", "2x3").refused("2 of 6", "--on-dark")
    masked = [*common, "--grid", "2x3", "--on-dark", "mask"]
    program(*masked, "--quiet", "--rtol", "2").refused("rtol is 2.0", "(--rtol)")
    assert program(*masked).code == 0
