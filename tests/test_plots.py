# SPDX-License-Identifier: BSD-3-Clause
"""What the plots hold; how they look is for people to judge."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import images, plots
from ltcl.errors import FileError, InputError
from ltcl.solvers import Solution, Status


def solution(method: str, residuals: tuple[float, ...], products: int) -> Solution:
    status = Status.CONVERGED if residuals[-1] < 1e-2 else Status.DIVERGED
    return Solution(np.zeros(1), status, len(residuals) - 1, products, residuals, 0.0, method)


SOLUTIONS = {
    "jacobi": solution("jacobi", (1.0, 2.0, float("inf")), 2),
    "neumann": solution("neumann", (1.0, 2.0), 2),
    "chebyshev": solution("chebyshev", (1.0, 0.1, 1e-3), 2),
    "direct": solution("direct", (1.0, 1e-16), 0),
    "of the future": solution("of the future", (1.0, 1e-3), 4),
}


def test_every_solution_has_its_curve_and_name() -> None:
    axes = plots.convergence(SOLUTIONS, rtol=1e-2).axes[0]
    curves = [line for line in axes.get_lines() if line.get_linewidth() > 1.0]  # thin ones lead to names
    assert len(curves) == len(SOLUTIONS) + 1  # and the tolerance
    names = {text.get_text().rstrip(" \u2193") for text in axes.texts}
    assert names == {*SOLUTIONS, "tolerance"}
    assert axes.get_xlim() == (0, 4)


@pytest.mark.parametrize(("solutions", "rtol"), [({}, 1e-2), (SOLUTIONS, 0.0), (SOLUTIONS, 2.0)])
def test_nothing_to_draw_is_refused(solutions: dict[str, Solution], rtol: float) -> None:
    with pytest.raises(InputError):
        plots.convergence(solutions, rtol)


@pytest.mark.parametrize("rtol", [1e-2, 1e-4])
def test_the_names_of_many_methods_do_not_touch(rtol):
    """Curves that end at nearly one place, and one far off at the same height."""
    rng, names = np.random.default_rng(0), [f"method_{i}" for i in range(11)]
    solutions = {
        name: solution(name, (1.0, float(rng.uniform(0.5, 1.0)) * rtol), int(rng.integers(3, 7)))
        for name in names
    } | {"far": solution("far", (1.0, rtol), 40)}
    figure = plots.convergence(solutions, rtol)
    figure.canvas.draw()
    boxes = {text.get_text(): text.get_window_extent() for text in figure.axes[0].texts}
    for one, other in itertools.combinations([*names, "far"], 2):
        assert not boxes[one].overlaps(boxes[other]), (one, other)
    y = figure.axes[0].transData.inverted().transform(boxes["far"].get_points())[:, 1]
    assert y[0] < rtol < y[1]  # nothing is near it, so it stays beside its curve


def sheet(colour: tuple[float, ...] = (0.5, 0.2, 0.1)) -> plots.Sheet:
    panel = plots.Panel("A label", "a note", np.full((30, 40, len(colour)), colour, np.float32))
    return plots.Sheet("Title", "subtitle", [panel] * 3, [panel] * 2, [panel] * 5, SOLUTIONS, 1e-2)


def test_contact_sheet_shows_the_pictures_as_they_are(tmp_path: Path) -> None:
    plots.save(plots.contact_sheet(sheet()), tmp_path / "sheet.png")
    picture = images.read(tmp_path / "sheet.png")
    assert picture.shape[1] == 1600
    same = np.abs(picture - (0.5, 0.2, 0.1)).max(axis=-1) < 0.01
    assert same.sum() > 3 * 450 * 330


def test_unknown_extension_and_failure_leave_the_old_file(tmp_path: Path) -> None:
    figure = plots.convergence(SOLUTIONS, 1e-2)
    with pytest.raises(InputError, match="plots are"):
        plots.save(figure, tmp_path / "plot.xyz")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(FileError):
        plots.save(figure, tmp_path / "folder.png")
    plots.save(figure, tmp_path / "plot.svg")
    assert {path.name for path in tmp_path.iterdir()} == {"folder.png", "plot.svg"}


def test_no_pyplot_and_no_matplotlib_before_the_first_plot() -> None:
    code = (
        "import sys; from ltcl import plots; assert 'matplotlib' not in sys.modules\n"
        "import tests.test_plots as t; plots.contact_sheet(t.sheet())\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).resolve().parents[1]
    )
    assert run.returncode == 0, run.stderr


def test_an_analysis_shows_every_channel_and_method(device) -> None:
    one = ltcl.analyze(ltcl.scenes.box(3, albedo=0.8).transport(device=device))
    left, right = plots.analysis({"a": one, "b": one}).axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["a", "b"]
    assert [label.get_text() for label in right.get_yticklabels()] == list(one.channels[0].products)
    said = [text.get_text().strip() for text in right.texts]
    assert said.count("diverges") == 4  # jacobi and neumann, twice
    with pytest.raises(InputError, match="found is empty"):
        plots.analysis({})
