# SPDX-License-Identifier: BSD-3-Clause
"""The demo shows what it claims."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltcl import demo, images
from ltcl.device import Device
from ltcl.errors import InputError

VIEWS = (
    "target",
    "uncompensated",
    "colours_only",
    "pattern",
    "compensated",
    *(f"bounce_{k}" for k in range(5)),
)


@pytest.fixture(scope="module")
def done(device: Device, tmp_path_factory: pytest.TempPathFactory) -> demo.Demo:
    steps: list[str] = []
    result = demo.run(tmp_path_factory.mktemp("demo") / "out", size=12, device=device, progress=steps.append)
    assert tuple(steps) == demo.STEPS
    return result


def test_all_files_are_there(done: demo.Demo) -> None:
    wanted = {f"{name}.png" for name in VIEWS} | {f"linear/{name}.exr" for name in VIEWS}
    wanted |= {"contact_sheet.png", "convergence.png", "report.json"}
    assert wanted == set(done.files)
    found = {path.relative_to(done.folder).as_posix() for path in done.folder.rglob("*") if path.is_file()}
    assert found == wanted


def test_compensation_helps(done: demo.Demo) -> None:
    errors = done.report["errors"]
    assert errors["compensated"] < 0.02
    assert errors["colours_only"] > 0.1
    assert errors["uncompensated"] > 0.1


def test_errors_are_those_of_the_pictures_on_disk(done: demo.Demo) -> None:
    target = images.read(done.folder / "linear" / "target.exr").astype(np.float64)
    for name, error in done.report["errors"].items():
        seen = images.read(done.folder / "linear" / f"{name}.exr").astype(np.float64)
        best = np.vdot(seen, target) / np.vdot(seen, seen) * seen
        assert np.linalg.norm(best - target) / np.linalg.norm(target) == pytest.approx(error, rel=1e-4)


def test_pattern_is_within_the_projectors_light(done: demo.Demo) -> None:
    pattern = images.read(done.folder / "linear" / "pattern.exr")
    assert pattern.min() >= 0
    assert 0.9 < pattern.max() <= 1
    assert done.report["compensation"]["clipped"] < 0.05


def test_the_papers_iteration_diverges_and_chebyshev_does_not(done: demo.Demo) -> None:
    assert done.report["spectral_radius"]["red"] > 1
    status = {method["method"]: method["status"] for method in done.report["convergence"]["methods"]}
    assert status == {
        "chebyshev": "converged",
        "jacobi": "diverged",
        "neumann": "diverged",
        "direct": "converged",
    }


def test_bounces_are_those_of_the_form_factors(done: demo.Demo) -> None:
    assert len(done.report["bounces"]) == 5
    for bounce in done.report["bounces"]:
        assert bounce["error"] < 0.005  # rtol = 1e-3, inherited by every further bounce


def test_size_is_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size"):
        demo.run(tmp_path / "out", size=3)
    assert list(tmp_path.iterdir()) == []
