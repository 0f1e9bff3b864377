# SPDX-License-Identifier: BSD-3-Clause
"""The demo's folder: views of the corner, linear pictures on the walls' grid, plots, the report.

The sheet of the compensation is written first, as soon as there is something to see. Views are
exposed to compare: each at the brightness at which it comes closest to the target,
bounces at that of the uncompensated picture times the factor in their note; report.json has the
factors. The files in ``linear/`` hold the values as they are.
"""

from __future__ import annotations

import importlib.util
import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl import images, plots
from ltcl.demo.experiment import ALBEDO, COLOURS, RTOL, CompensatedCorner, Experiment
from ltcl.demo.sheet import write_sheet
from ltcl.scenes import RefinedScene, camera
from ltcl.tasks import report
from ltcl.transport.verdict import Verdict

_logger = logging.getLogger(__name__)
VIEW_PIXELS = 800  # along the longer side of a view
TITLE = "A picture projected into a coloured corner"
SUBTITLE = (
    "The walls colour it and light each other. "
    "With the pattern of ltcl they look like a flat white screen.\n"
    "{below}{h} x {w} pixels."
)
BOUNCES_BELOW = (
    "Below: the light of the first picture taken apart, by how often it went from wall to wall. "
)
COMPENSATION_SHEET = "compensation.png"
CONTACT_SHEET = "contact_sheet.png"
# On the T of the demo. `analyze` looks for noise, and advises to measure it.
VERDICT = Verdict("Unknown: this T is simulated and has no noise to judge by.")
STORY = ("uncompensated", "pattern", "compensated")


class Shown(NamedTuple):
    """A picture with its label and note, the exposure of its view, and linear values."""

    label: str
    exposure: float
    picture: np.ndarray


def write_compensation(corner: CompensatedCorner, folder: Path) -> dict[str, np.ndarray]:
    """Write the sheet of the compensation alone; returns its views by their names."""
    shown = compensation_pictures(corner)
    story = {name: shown[name] for name in STORY}
    views = draw_views(corner.scene, story)
    h, w = corner.scene.grid
    subtitle = SUBTITLE.format(below="", h=h, w=w)
    write_sheet(folder / COMPENSATION_SHEET, [_labelled(story, views)], TITLE, subtitle)
    return views


def write_pictures(results: Experiment, drawn: dict[str, np.ndarray], folder: Path) -> None:
    """Write views and plots into `folder`, linear values into its subfolder ``linear``.

    `drawn` are views that are there already.
    """
    shown = shown_pictures(results)
    scene = results.corner.scene
    missing = {name: entry for name, entry in shown.items() if name not in drawn}
    views = {**drawn, **draw_views(scene, missing)}
    for name, entry in shown.items():
        images.write(folder / "linear" / f"{name}.exr", entry.picture)
        images.write(folder / f"{name}.png", views[name])

    write_convergence(results, folder / "convergence.png")
    story = {name: shown[name] for name in STORY}
    bounces = {name: entry for name, entry in shown.items() if name.startswith("bounce_")}
    rows = [_labelled(story, views), _labelled(bounces, views)]
    h, w = scene.grid
    subtitle = SUBTITLE.format(below=BOUNCES_BELOW, h=h, w=w)
    write_sheet(folder / CONTACT_SHEET, rows, TITLE, subtitle)


def _labelled(shown: dict[str, Shown], views: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Views by their labels, a row of a sheet."""
    return {entry.label: views[name] for name, entry in shown.items()}


def write_convergence(results: Experiment, path: Path) -> None:
    """Plot the race of methods, if Matplotlib is installed."""
    if importlib.util.find_spec("matplotlib") is None:
        _logger.info('%s is left out: python -m pip install "ltcl[plots]" draws it', path.name)
        return
    rho = results.analysis.channels[results.worst].spectral_radius
    title = f"Solving for the {COLOURS[results.worst]} light, \u03c1(R) = {rho:.2f}"
    plots.save(plots.convergence(results.race, RTOL, title), path)


def draw_views(scene: RefinedScene, shown: dict[str, Shown]) -> dict[str, np.ndarray]:
    """The corner as its viewer sees it, (h, w, 3), under each picture, along the same rays."""
    exposed = [entry.exposure * entry.picture for entry in shown.values()]
    stacked = camera.draw(
        scene.viewer, scene.walls, np.concatenate(exposed, axis=2), VIEW_PIXELS, supersample=2
    )
    views = np.split(stacked, len(shown), axis=2)
    return dict(zip(shown, views, strict=True))


def report_of(results: Experiment, seconds: dict[str, float]) -> dict[str, Any]:
    """The content of report.json, as plain data."""
    corner = results.corner
    scene = corner.scene
    compensation = corner.compensation
    radii = [channel.spectral_radius for channel in results.analysis.channels]
    walls = [wall.name for wall in scene.walls]
    exposures = {name: entry.exposure for name, entry in shown_pictures(results).items()}
    methods = [report.solution(solution)[0] for solution in results.race.values()]
    content = {
        "versions": report.versions(),
        "device": report.device(corner.T.device),
        "scene": {
            "grid": scene.grid,
            "pixels": len(scene.area),
            "albedo": dict(zip(walls, ALBEDO, strict=True)),
        },
        "spectral_radius": dict(zip(COLOURS, radii, strict=True)),
        "analysis": {**results.analysis.to_dict(), "verdict": report.plain(VERDICT)},
        "target": {"mist": corner.mist},
        "errors": {name: look.error for name, look in corner.looks.items()},
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
    total = float(np.linalg.norm(results.corner.looks["uncompensated"].seen))
    entries = []
    for number, bounce in enumerate(results.bounces):
        share = float(np.linalg.norm(bounce)) / total
        error = results.bounce_errors[number]
        entries.append({"bounce": number, "share": share, "error": error})
    return entries


def compensation_pictures(corner: CompensatedCorner) -> dict[str, Shown]:
    """Pictures of the compensation, by the names of their files."""
    shown = {"target": Shown("Desired", 1.0, corner.target)}
    labels = {
        "uncompensated": "Projected as it is",
        "colours_only": "Colours only",
        "compensated": "What is seen then",
    }
    for name, look in corner.looks.items():
        note = f"{100 * look.error:.1f} % error"
        if name == "compensated":
            note += f", {100 * corner.compensation.gain:.0f} % of the brightness"
        shown[name] = Shown(f"{labels[name]}\n{note}", look.exposure, look.seen)
    pattern = corner.compensation.pattern
    shown["pattern"] = Shown("The pattern that ltcl finds\nto be projected instead", 1.0, pattern)
    return shown


def shown_pictures(results: Experiment) -> dict[str, Shown]:
    """All pictures, by the names of their files."""
    shown = compensation_pictures(results.corner)
    exposure = results.corner.looks["uncompensated"].exposure
    direct = np.linalg.norm(results.bounces[0])
    for number, bounce in enumerate(results.bounces):
        times = float(direct / np.linalg.norm(bounce))
        if number == 0:
            label = "Direct light\nas bright as above"
        else:
            label = f"Bounce {number}\n{times:.1f} times as bright"
        shown[f"bounce_{number}"] = Shown(label, times * exposure, bounce)
    return shown
