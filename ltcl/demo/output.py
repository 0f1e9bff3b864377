# SPDX-License-Identifier: BSD-3-Clause
"""The demo's folder: views of the corner, linear pictures on the walls' grid, plots, the report.

Views are exposed to compare: each at the brightness at which it comes closest to the target,
bounces at that of the uncompensated picture times the factor in their note; report.json has the
factors. All are drawn at once, along the same rays. The files in ``linear/`` hold the values as
they are.
"""

from __future__ import annotations

import importlib.util
import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl import images, plots
from ltcl.demo.experiment import ALBEDO, COLOURS, RTOL, Experiment
from ltcl.demo.sheet import write_sheet
from ltcl.scenes import camera
from ltcl.tasks import report
from ltcl.transport.verdict import Verdict

_logger = logging.getLogger(__name__)
VIEW_PIXELS = 800  # along the longer side of a view
TITLE = "A picture projected into a coloured corner"
SUBTITLE = (
    "The walls colour it and light each other. "
    "With the pattern of ltcl they look like a flat white screen.\n"
    "Below: the light of the first picture taken apart, by how often it went from wall to wall. "
    "{h} x {w} pixels."
)
# On the T of the demo. `analyze` looks for noise, and advises to measure it.
VERDICT = Verdict("Unknown: this T is simulated and has no noise to judge by.")
STORY = ("uncompensated", "pattern", "compensated")


class Shown(NamedTuple):
    """A picture with its label and note, the exposure of its view, and linear values."""

    label: str
    exposure: float
    picture: np.ndarray


def write_pictures(results: Experiment, folder: Path) -> None:
    """Write views and plots into `folder`, linear values into its subfolder ``linear``."""
    shown = shown_pictures(results)
    views = draw_views(results, shown)
    for name, entry in shown.items():
        images.write(folder / "linear" / f"{name}.exr", entry.picture)
        images.write(folder / f"{name}.png", views[name])

    write_convergence(results, folder / "convergence.png")
    bounces = [name for name in shown if name.startswith("bounce_")]
    rows = []
    for names in (STORY, bounces):
        rows.append({shown[name].label: views[name] for name in names})
    h, w = results.scene.grid
    write_sheet(folder / "contact_sheet.png", rows, TITLE, SUBTITLE.format(h=h, w=w))


def write_convergence(results: Experiment, path: Path) -> None:
    """Plot the race of methods, if Matplotlib is installed."""
    if importlib.util.find_spec("matplotlib") is None:
        _logger.info('%s is left out: python -m pip install "ltcl[plots]" draws it', path.name)
        return
    rho = results.analysis.channels[results.worst].spectral_radius
    title = f"Solving for the {COLOURS[results.worst]} light, \u03c1(R) = {rho:.2f}"
    plots.save(plots.convergence(results.race, RTOL, title), path)


def draw_views(results: Experiment, shown: dict[str, Shown]) -> dict[str, np.ndarray]:
    """The corner as its viewer sees it, (h, w, 3), under each picture."""
    scene = results.scene
    exposed = [entry.exposure * entry.picture for entry in shown.values()]
    stacked = camera.draw(
        scene.viewer, scene.walls, np.concatenate(exposed, axis=2), VIEW_PIXELS, supersample=2
    )
    views = np.split(stacked, len(shown), axis=2)
    return dict(zip(shown, views, strict=True))


def report_of(results: Experiment, seconds: dict[str, float]) -> dict[str, Any]:
    """The content of report.json, as plain data."""
    scene = results.scene
    compensation = results.compensation
    radii = [channel.spectral_radius for channel in results.analysis.channels]
    walls = [wall.name for wall in scene.walls]
    exposures = {name: entry.exposure for name, entry in shown_pictures(results).items()}
    methods = [report.solution(solution)[0] for solution in results.race.values()]
    content = {
        "versions": report.versions(),
        "device": report.device(results.T.device),
        "scene": {
            "grid": scene.grid,
            "pixels": len(scene.area),
            "albedo": dict(zip(walls, ALBEDO, strict=True)),
        },
        "spectral_radius": dict(zip(COLOURS, radii, strict=True)),
        "analysis": {**results.analysis.to_dict(), "verdict": report.plain(VERDICT)},
        "target": {"mist": results.mist},
        "errors": {name: look.error for name, look in results.looks.items()},
        "exposure_of_views": exposures,
        "compensation": {
            "gain": compensation.gain,
            "clipped": compensation.clipped,
            "channels": report.solution(compensation.solution),
        },
        "bounces": bounces_report(results),
        "convergence": {"channel": COLOURS[results.worst], "methods": methods},
        "seconds": seconds,
    }
    return report.plain(content)


def bounces_report(results: Experiment) -> list[dict[str, Any]]:
    """Share of the light and error of each bounce."""
    total = float(np.linalg.norm(results.looks["uncompensated"].seen))
    entries = []
    for number, bounce in enumerate(results.bounces):
        share = float(np.linalg.norm(bounce)) / total
        error = results.bounce_errors[number]
        entries.append({"bounce": number, "share": share, "error": error})
    return entries


def shown_pictures(results: Experiment) -> dict[str, Shown]:
    """All pictures, by the names of their files."""
    shown = {"target": Shown("Desired", 1.0, results.target)}
    labels = {
        "uncompensated": "Projected as it is",
        "colours_only": "Colours only",
        "compensated": "What is seen then",
    }
    for name, look in results.looks.items():
        note = f"{100 * look.error:.1f} % error"
        if name == "compensated":
            note += f", {100 * results.compensation.gain:.0f} % of the brightness"
        shown[name] = Shown(f"{labels[name]}\n{note}", look.exposure, look.seen)
    pattern = results.compensation.pattern
    shown["pattern"] = Shown("The pattern that ltcl finds\nto be projected instead", 1.0, pattern)

    exposure = results.looks["uncompensated"].exposure
    direct = np.linalg.norm(results.bounces[0])
    for number, bounce in enumerate(results.bounces):
        times = float(direct / np.linalg.norm(bounce))
        if number == 0:
            label = "Direct light\nas bright as above"
        else:
            label = f"Bounce {number}\n{times:.1f} times as bright"
        shown[f"bounce_{number}"] = Shown(label, times * exposure, bounce)
    return shown
