# SPDX-License-Identifier: BSD-3-Clause
"""The demo shows what it claims, and says where to look."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl import demo, images
from ltcl.errors import InputError, InputTypeError
from tests import json_schema

from .conftest import Outcome, Program


@pytest.fixture(scope="module")
def done(program: Program, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, Outcome]:
    """Folder, contents of report.json, and what was printed."""
    out = tmp_path_factory.mktemp("demo")
    outcome = program("demo", "--out", out, "--size", "12", "--verbose")
    return out, json.loads((out / "report.json").read_text()), outcome


def test_errors_are_those_of_the_pictures_on_disk_and_compensation_helps(done):
    out, report, outcome = done
    target = images.read(out / "linear" / "target.exr").astype(np.float64)
    for name, error in report["errors"].items():
        seen = images.read(out / "linear" / f"{name}.exr").astype(np.float64)
        best = np.vdot(seen, target) / np.vdot(seen, seen) * seen
        assert np.linalg.norm(best - target) / np.linalg.norm(target) == pytest.approx(
            error, rel=1e-4
        )
        assert (error < 0.02) if name == "compensated" else (error > 0.1)
        assert f"{100 * error:.3g} %" in outcome.out
    pattern = images.read(out / "linear" / "pattern.exr")
    assert 0 <= pattern.min() < 0.9 < pattern.max() <= 1
    assert report["compensation"]["clipped"] < 0.05


def test_files_and_steps_are_listed(done):
    out, report, outcome = done
    views = ["target", "uncompensated", "colours_only", "pattern", "compensated"]
    views += [f"bounce_{k}" for k in range(5)]
    files = {f"{name}.png" for name in views} | {f"linear/{name}.exr" for name in views}
    files |= {"contact_sheet.png", "convergence.png", "report.json"}
    assert {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()} == files
    assert all(
        text in outcome.out for text in (f"{len(files)} files", str(out / "contact_sheet.png"))
    )
    json_schema.check(["demo"], {"folder": str(out), "files": sorted(files), **report})
    steps = [line.removeprefix("ltcl: ") for line in outcome.err.splitlines()]
    assert steps == [*demo.STEPS] == [*report["seconds"]]
    for name in ("size", "progress"):
        changed: dict[str, Any] = {name: 3}
        with pytest.raises((InputError, InputTypeError), match=f"{name} is 3"):
            demo.run(out, **changed)


def test_the_papers_iteration_diverges_and_chebyshev_does_not(done):
    _, report, _ = done
    assert report["spectral_radius"]["red"] > 1
    status = {method["method"]: method["status"] for method in report["convergence"]["methods"]}
    ended = {
        "chebyshev": "converged",
        "jacobi": "diverged",
        "neumann": "diverged",
        "direct": "converged",
    }
    assert status == ended
    errors = [bounce["error"] for bounce in report["bounces"]]  # against those of the form factors
    assert (len(errors), max(errors) < 0.005) == (
        5,
        True,
    )  # rtol = 1e-3, inherited by every further bounce
