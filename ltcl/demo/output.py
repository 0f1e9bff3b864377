# SPDX-License-Identifier: BSD-3-Clause
"""The demo's folder: views of the corner, linear pictures on the walls' grid, plots, the report.

Views are exposed to compare: each at the brightness at which it comes closest to the target, with that factor
in its note; bounces at that of the uncompensated picture times the factor in theirs. The files in ``linear/``
hold the values as they are.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import images, plots, report
from ltcl.demo.experiment import ALBEDO, COLOURS, RTOL, Experiment

_VIEW = 800  # pixels along the longer side of a view


def write_pictures(results: Experiment, folder: Path) -> None:
    """Views and plots into `folder`, linear values into its subfolder ``linear``."""
    panels = {}
    for name, (label, note, exposure, picture) in _pictures(results).items():
        images.write(folder / "linear" / f"{name}.exr", picture)
        view = results.scene.view(exposure * picture, size=_VIEW, supersample=2)
        images.write(folder / f"{name}.png", view)
        panels[name] = plots.Panel(label, note, view)
    rho = results.analysis.channels[results.worst].spectral_radius
    colour, gain = COLOURS[results.worst], results.compensation.gain
    products = " + ".join(
        str(channel["products"]) for channel in report.solution(results.compensation.solution)
    )
    title = f"Solving for the {colour} light, \u03c1(R) = {rho:.2f}"
    plots.save(plots.convergence(results.race, RTOL, title), folder / "convergence.png")
    subtitle = (
        f"Bounces undone in {products} products, at {100 * gain:.0f} % of the desired brightness; "
        f"\u03c1(R) = {rho:.2f} in {colour}, where the plain iteration diverges."
    )
    large, medium = ("target", "uncompensated", "compensated"), ("colours_only", "pattern")
    rows = [[panels[name] for name in row] for row in (large, medium, [*panels][5:])]
    heading = "A picture projected into a coloured corner"
    sheet = plots.contact_sheet(heading, subtitle, rows, (title, results.race, RTOL))
    plots.save(sheet, folder / "contact_sheet.png")


def report_of(results: Experiment, seconds: dict[str, float]) -> dict[str, Any]:
    """What goes into report.json, as plain data."""
    scene, compensation = results.scene, results.compensation
    total = float(np.linalg.norm(results.looks["uncompensated"].seen))
    radii = [channel.spectral_radius for channel in results.analysis.channels]
    return report.plain(
        {
            "versions": report.versions(),
            "device": report.device(results.T.device),
            "scene": {
                "grid": scene.grid,
                "pixels": len(scene.area),
                "albedo": {wall.name: albedo for wall, albedo in zip(scene.walls, ALBEDO, strict=True)},
            },
            "spectral_radius": dict(zip(COLOURS, radii, strict=True)),
            "analysis": results.analysis.to_dict(),
            "target": {"mist": results.mist},
            "errors": {name: look.error for name, look in results.looks.items()},
            "exposure_of_views": {name: exposure for name, (_, _, exposure, _) in _pictures(results).items()},
            "compensation": {
                "gain": compensation.gain,
                "clipped": compensation.clipped,
                "channels": report.solution(compensation.solution),
            },
            "bounces": [
                {"bounce": k, "share": float(np.linalg.norm(bounce)) / total, "error": error}
                for k, (bounce, error) in enumerate(zip(results.bounces, results.bounce_errors, strict=True))
            ],
            "convergence": {
                "channel": COLOURS[results.worst],
                "methods": [report.solution(solution)[0] for solution in results.race.values()],
            },
            "seconds": seconds,
        }
    )


def _pictures(results: Experiment) -> dict[str, tuple[str, str, float, np.ndarray]]:
    """Label, note, exposure and linear values of each picture, by the name of its file."""
    mist = f"{100 * results.mist:.0f} % mist added" if results.mist >= 0.005 else ""
    pictures = {"target": ("Desired", mist, 1.0, results.target)}
    labels = {"uncompensated": "As it is", "compensated": "Compensated", "colours_only": "Colours only"}
    for name, label in labels.items():
        look = results.looks[name]
        shown = "" if name == "colours_only" else "shown "  # its panel has less room
        note = f"{100 * look.error:.1f} % error, {shown}\u00d7 {look.exposure:.2g}"
        pictures[name] = (label, note, look.exposure, look.seen)
    pictures["pattern"] = ("Pattern", "what is projected", 1.0, results.compensation.pattern)
    exposure, direct = results.looks["uncompensated"].exposure, np.linalg.norm(results.bounces[0])
    for k, bounce in enumerate(results.bounces):
        times = float(direct / np.linalg.norm(bounce))
        label = f"Bounce {k}" if k else "Direct light"
        pictures[f"bounce_{k}"] = (label, f"\u00d7 {times:.1f}", times * exposure, bounce)
    return pictures
