# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl demo`: its results are on disk, and its report lists them."""

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

pytestmark = pytest.mark.slow

VIEWS = [
    "target",
    "uncompensated",
    "colours_only",
    "pattern",
    "compensated",
    *(f"bounce_{number}" for number in range(5)),
]
SHEETS = {"compensation.png", "contact_sheet.png", "convergence.png", "report.json"}


@pytest.fixture(scope="module")
def done(program: Program, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, Outcome]:
    """Folder, contents of report.json, and the outcome."""
    out = tmp_path_factory.mktemp("demo")
    outcome = program("demo", "--out", out, "--size", "12", "--verbose")
    report = json.loads((out / "report.json").read_text())
    return out, report, outcome


def test_errors_are_those_of_the_pictures_on_disk_and_compensation_helps(done):
    out, report, outcome = done
    target = images.read(out / "linear" / "target.exr").astype(np.float64)
    for name, error in report["errors"].items():
        seen = images.read(out / "linear" / f"{name}.exr").astype(np.float64)
        best = np.vdot(seen, target) / np.vdot(seen, seen) * seen
        measured = np.linalg.norm(best - target) / np.linalg.norm(target)
        assert measured == pytest.approx(error, rel=1e-4)
        assert f"{100 * error:.3g} %" in outcome.out
    assert report["errors"]["compensated"] < 0.02
    assert report["errors"]["uncompensated"] > 0.1
    assert report["errors"]["colours_only"] > 0.1


def test_the_pattern_is_bright_and_hardly_clipped(done):
    out, report, _ = done
    pattern = images.read(out / "linear" / "pattern.exr")
    assert pattern.min() >= 0
    assert 0.9 < pattern.max() <= 1
    assert report["compensation"]["clipped"] < 0.05


@pytest.mark.slow
def test_files_are_listed(done):
    out, report, outcome = done
    files = {*SHEETS}
    for view in VIEWS:
        files |= {f"{view}.png", f"linear/{view}.exr"}
    written = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert written == files
    assert f"{len(files)} files" in outcome.out
    assert str(out / "contact_sheet.png") in outcome.out
    json_schema.check(["demo"], {"folder": str(out), "files": sorted(files), **report})


def test_steps_are_told(done):
    _, report, outcome = done
    lines = [line.removeprefix("ltcl: ") for line in outcome.err.splitlines()]
    steps = [line for line in lines if "compensation.png" not in line]
    assert steps == [*demo.STEPS]
    assert steps == [*report["seconds"]]


def test_the_picture_is_announced_before_the_bounces(done):
    out, _, outcome = done
    lines = outcome.err.splitlines()
    (place,) = (number for number, line in enumerate(lines) if "compensation.png" in line)
    assert str(out / "compensation.png") in lines[place]
    assert "bounces" in lines[place]
    assert lines[place + 1] == "ltcl: analysis"


class Stopped(Exception):
    """Raised where a demo ends early."""


def test_the_picture_is_whole_when_it_is_announced(tmp_path):
    """It alone is there by then, and stays if the demo ends there."""
    out = tmp_path / "demo"

    def stop(picture: Path) -> None:
        assert picture == out / "compensation.png"
        assert [path.name for path in out.iterdir()] == [picture.name]
        sheet = images.read(picture)
        assert sheet.shape[1:] == (1600, 3)
        assert sheet.std() > 0.1
        raise Stopped

    with pytest.raises(Stopped):
        demo.run(out, size=4, announce=stop)
    assert [path.name for path in out.iterdir()] == ["compensation.png"]


@pytest.mark.parametrize("name", ["size", "progress", "announce"])
def test_bad_arguments_are_named(tmp_path, name):
    changed: dict[str, Any] = {name: 3}
    with pytest.raises((InputError, InputTypeError), match=f"{name} is 3"):
        demo.run(tmp_path, **changed)


def test_the_papers_iteration_diverges_and_chebyshev_does_not(done):
    _, report, _ = done
    assert report["spectral_radius"]["red"] > 1
    methods = report["convergence"]["methods"]
    assert {method["method"]: method["status"] for method in methods} == {
        "chebyshev": "converged",
        "gmres": "converged",
        "jacobi": "diverged",
        "neumann": "diverged",
    }


def test_the_verdict_says_that_a_simulated_transport_has_no_noise(done):
    _, report, _ = done
    verdict = report["analysis"]["verdict"]
    assert verdict["text"] == "Unknown: this T is simulated and has no noise to judge by."
    assert verdict["compensation"] is None
    assert verdict["bounces"] is None


@pytest.mark.slow
def test_bounces_are_those_of_the_form_factors(done):
    _, report, _ = done
    errors = [bounce["error"] for bounce in report["bounces"]]
    assert len(errors) == 5
    # rtol is 1e-4, and each further bounce inherits the error of the one before.
    assert max(errors) < 0.001
