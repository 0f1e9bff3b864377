# SPDX-License-Identifier: BSD-3-Clause
"""Contents of the plots; how they look is for people to judge."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageShow

import ltcl
from ltcl import images, plots
from ltcl.device import Device
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.solvers import Solution, Status

pytestmark = pytest.mark.slow


def solution(method: str, residuals: tuple[float, ...], products: int) -> Solution:
    status = Status.CONVERGED if residuals[-1] < 1e-2 else Status.DIVERGED
    return Solution(
        x=np.zeros(1),
        status=status,
        iterations=len(residuals) - 1,
        products=products,
        residuals=residuals,
        method=method,
    )


SOLUTIONS = {
    "jacobi": solution("jacobi", (1.0, 2.0, float("inf")), 2),
    "chebyshev": solution("chebyshev", (1.0, 0.1, 1e-3), 2),
    "direct": solution("direct", (1.0, 1e-16), 0),
    "of the future": solution("of the future", (1.0, 1e-3), 4),
}


def test_every_solution_has_its_curve_and_name() -> None:
    axes = plots.convergence(SOLUTIONS, rtol=1e-2).axes[0]
    names = {label.rstrip(" \u2193") for label in axes.get_legend_handles_labels()[1]}
    assert names == {*SOLUTIONS, "tolerance"}
    assert (len(axes.get_lines()), axes.get_xlim()) == (len(names), (0, 4))
    for solutions, rtol in (({}, 1e-2), (SOLUTIONS, 2.0)):
        with pytest.raises(InputError):
            plots.convergence(solutions, rtol)


def sheet() -> object:
    picture = np.full((30, 40, 3), (0.5, 0.2, 0.1), np.float32)
    named = {"A label\na note": picture, "grey": picture[..., 0]}
    return plots.pictures(named, {"small": picture[:2, :2]}, title="Title")


def test_pictures_are_shown_as_they_are_under_their_names(tmp_path: Path) -> None:
    plots.save(sheet(), tmp_path / "sheet.png")  # pyright: ignore[reportArgumentType]
    picture = images.read(tmp_path / "sheet.png")
    shown = (np.abs(picture - (0.5, 0.2, 0.1)).max(axis=-1) < 0.01).sum()
    assert shown == pytest.approx(467 * 350 + 950**2, rel=0.01)
    for rows in ((), ({},), ({"a": np.ones(3)},)):
        with pytest.raises(InputError):
            plots.pictures(*rows)


@pytest.fixture(scope="module")
def figures(device: Device) -> list[Any]:
    """A figure of each kind; one solution or analysis may stand alone."""
    T = ltcl.scenes.box(3, albedo=0.8).transport(device=device)
    analysis = ltcl.analyze(T)
    return [
        sheet(),
        plots.convergence(SOLUTIONS, rtol=1e-2),
        plots.convergence(SOLUTIONS["jacobi"], rtol=1e-2),
        plots.analysis({"a": analysis}),
        plots.analysis(analysis),
    ]


@pytest.mark.slow
def test_notebooks_show_every_figure(figures, tmp_path: Path) -> None:
    for figure in figures:
        plots.save(figure, tmp_path / "saved.png")
        shown = Image.open(io.BytesIO(figure._repr_png_()))
        saved = images.read_codes(tmp_path / "saved.png")
        np.testing.assert_array_equal(np.asarray(shown)[..., :3], saved[..., :3])


def test_prompts_show_every_figure(figures, monkeypatch, caplog) -> None:
    sizes = []

    def view(picture: Image.Image, _title: str) -> bool:
        sizes.append(picture.size)
        return len(sizes) > 1

    monkeypatch.setattr(ImageShow, "show", view)
    for figure in figures:
        assert "show()" in repr(figure)
        figure.show()
    assert sizes == [figure.canvas.get_width_height() for figure in figures]
    # The first one had no program that shows it.
    assert len(caplog.records) == 1
    assert "ltcl.plots.save" in caplog.text


@pytest.mark.parametrize(
    ("draw", "name"),
    [
        (lambda: plots.analysis([]), "analyses is a list"),  # pyright: ignore[reportArgumentType]
        (lambda: plots.analysis({"a": 1}), r"analyses\['a'\] is a int"),  # pyright: ignore[reportArgumentType]
        (lambda: plots.convergence({"a": None}, 0.1), r"solutions\['a'\]"),  # pyright: ignore[reportArgumentType]
        (lambda: plots.convergence(np.ones(2), 0.1), "solutions is a ndarray"),  # pyright: ignore[reportArgumentType]
        (lambda: plots.pictures(np.ones((2, 2))), "rows is a ndarray"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_what_cannot_be_drawn_is_named(draw: Any, name: str) -> None:
    with pytest.raises(InputTypeError, match=name):
        draw()


def test_unknown_extension_and_failure_leave_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "folder.png").mkdir()
    for name, error in (("plot.xyz", InputError), ("folder.png", FileError)):
        with pytest.raises(error):
            plots.save(plots.convergence(SOLUTIONS, 1e-2), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]


@pytest.mark.slow
def test_no_pyplot_and_no_matplotlib_before_the_first_plot() -> None:
    code = (
        "import sys; from ltcl import plots; assert 'matplotlib' not in sys.modules\n"
        "import tests.test_plots as t; t.sheet(); assert 'matplotlib.pyplot' not in sys.modules"
    )
    root = Path(__file__).resolve().parents[1]
    subprocess.run([sys.executable, "-c", code], cwd=root, check=True)


def test_an_analysis_shows_every_channel_and_method(device) -> None:
    analysis = ltcl.analyze(ltcl.scenes.box(3, albedo=0.8).transport(device=device))
    left, right = plots.analysis({"a": analysis, "b": analysis}).axes
    assert [label.get_text() for label in left.get_yticklabels()] == ["a", "b"]
    assert [label.get_text() for label in right.get_yticklabels()] == list(
        analysis.channels[0].products
    )
    assert [text.get_text().strip() for text in right.texts].count(
        "diverges"
    ) == 4  # jacobi, neumann; twice
