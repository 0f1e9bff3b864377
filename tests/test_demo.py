# SPDX-License-Identifier: BSD-3-Clause
"""The demo shows what it claims."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltcl import demo, images
from ltcl.device import Device
from ltcl.errors import InputError

VIEWS = ["target", "uncompensated", "colours_only", "pattern", "compensated"]
VIEWS += [f"bounce_{k}" for k in range(5)]


@pytest.fixture(scope="module")
def done(device: Device, tmp_path_factory: pytest.TempPathFactory) -> demo.Demo:
    steps: list[str] = []
    result = demo.run(tmp_path_factory.mktemp("demo") / "out", size=12, device=device, progress=steps.append)
    assert tuple(steps) == demo.STEPS == tuple(result.report["seconds"])
    return result


def test_errors_are_those_of_the_pictures_on_disk_and_compensation_helps(done: demo.Demo) -> None:
    files = {f"{name}.png" for name in VIEWS} | {f"linear/{name}.exr" for name in VIEWS}
    assert {*done.files} == files | {"contact_sheet.png", "convergence.png", "report.json"}
    assert all((done.folder / name).is_file() for name in done.files)
    target = images.read(done.folder / "linear" / "target.exr").astype(np.float64)
    for name, error in done.report["errors"].items():
        seen = images.read(done.folder / "linear" / f"{name}.exr").astype(np.float64)
        best = np.vdot(seen, target) / np.vdot(seen, seen) * seen
        assert np.linalg.norm(best - target) / np.linalg.norm(target) == pytest.approx(error, rel=1e-4)
        assert (error < 0.02) if name == "compensated" else (error > 0.1)
    pattern = images.read(done.folder / "linear" / "pattern.exr")
    assert 0 <= pattern.min() < 0.9 < pattern.max() <= 1
    assert done.report["compensation"]["clipped"] < 0.05


def test_the_papers_iteration_diverges_and_chebyshev_does_not(done: demo.Demo) -> None:
    assert done.report["spectral_radius"]["red"] > 1
    status = {method["method"]: method["status"] for method in done.report["convergence"]["methods"]}
    ended = {"chebyshev": "converged", "jacobi": "diverged", "neumann": "diverged", "direct": "converged"}
    assert status == ended
    errors = [bounce["error"] for bounce in done.report["bounces"]]  # against those of the form factors
    assert (len(errors), max(errors) < 0.005) == (5, True)  # rtol = 1e-3, inherited by every further bounce


def test_size_is_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size"):
        demo.run(tmp_path / "out", size=3)
    assert list(tmp_path.iterdir()) == []
