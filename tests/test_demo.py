# SPDX-License-Identifier: BSD-3-Clause
"""The demo shows what it claims."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ltcl import demo, images
from ltcl.demo import experiment, output
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


def test_report_on_disk_is_the_one_returned(done: demo.Demo) -> None:
    assert json.loads((done.folder / "report.json").read_text()) == done.report


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


def test_contact_sheet_is_wide(done: demo.Demo) -> None:
    sheet = images.read(done.folder / "contact_sheet.png")
    assert sheet.shape[1] == 1600


def test_small_demos_iterate_too(done: demo.Demo) -> None:
    for channel in done.report["compensation"]["channels"]:  # 432 pixels: "auto" would factorize
        assert channel["method"] == "chebyshev"
        assert channel["products"] > 0


def test_sheet_tells_mist_and_brightness(device: Device) -> None:
    found = experiment.compute(8, device, lambda step: None)
    captions = output._captions(found)
    assert captions["target"][1] == f"{100 * found.target.mist:.0f} % mist added"
    for name in ("uncompensated", "compensated", "colours_only"):
        look = getattr(found, name)
        assert captions[name][1].startswith(f"{100 * look.error:.1f} % error, ")
        assert captions[name][1].endswith(f"\u00d7 {look.exposure:.2g}")
    assert f"at {100 * found.compensation.gain:.0f} % of the wanted brightness" in output._subtitle(found)


def test_size_is_checked(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size"):
        demo.run(tmp_path / "out", size=3)
    assert list(tmp_path.iterdir()) == []
