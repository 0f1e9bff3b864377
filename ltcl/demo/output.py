# SPDX-License-Identifier: BSD-3-Clause
"""The demo's folder: views of the corner, linear pictures on the walls' grid, plots, the report.

Views are exposed to compare: each at the brightness at which it comes closest to the target,
bounces at that of the uncompensated picture times the factor in their note; report.json has the
factors. All are drawn at once, along the same rays. The files in ``linear/`` hold the values as
they are.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import images, plots
from ltcl.demo.experiment import ALBEDO, COLOURS, RTOL, Experiment
from ltcl.scenes import viewer
from ltcl.tasks import report

_VIEW = 800  # pixels along the longer side of a view
_TITLE = "A picture projected into a coloured corner"
_SUBTITLE = (
    "The walls colour it and light each other. With the pattern of ltcl they look like a flat white screen.\n"
    "Below: the light of the first picture taken apart, by how often it went from wall to wall."
)


def write_pictures(results: Experiment, folder: Path) -> None:
    """Views and plots into `folder`, linear values into its subfolder ``linear``."""
    shown, scene = _pictures(results), results.scene
    exposed = [exposure * picture for _, exposure, picture in shown.values()]
    stacked = viewer.draw(
        scene.viewer, scene.walls, np.concatenate(exposed, axis=2), _VIEW, supersample=2
    )
    views = {
        label: stacked[..., 3 * k : 3 * k + 3] for k, (label, _, _) in enumerate(shown.values())
    }
    for name, (label, _, picture) in shown.items():
        images.write(folder / "linear" / f"{name}.exr", picture)
        images.write(folder / f"{name}.png", views[label])
    rho = results.analysis.channels[results.worst].spectral_radius
    title = f"Solving for the {COLOURS[results.worst]} light, \u03c1(R) = {rho:.2f}"
    plots.save(plots.convergence(results.race, RTOL, title), folder / "convergence.png")
    story = [shown[name][0] for name in ("uncompensated", "pattern", "compensated")]
    rows = [{label: views[label] for label in labels} for labels in (story, [*views][5:])]
    sheet = plots.pictures(*rows, title=_TITLE, subtitle=_SUBTITLE, width=1600)
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
                "albedo": {
                    wall.name: albedo for wall, albedo in zip(scene.walls, ALBEDO, strict=True)
                },
            },
            "spectral_radius": dict(zip(COLOURS, radii, strict=True)),
            "analysis": results.analysis.to_dict(),
            "target": {"mist": results.mist},
            "errors": {name: look.error for name, look in results.looks.items()},
            "exposure_of_views": {
                name: exposure for name, (_, exposure, _) in _pictures(results).items()
            },
            "compensation": {
                "gain": compensation.gain,
                "clipped": compensation.clipped,
                "channels": report.solution(compensation.solution),
            },
            "bounces": [
                {"bounce": k, "share": float(np.linalg.norm(bounce)) / total, "error": error}
                for k, (bounce, error) in enumerate(
                    zip(results.bounces, results.bounce_errors, strict=True)
                )
            ],
            "convergence": {
                "channel": COLOURS[results.worst],
                "methods": [report.solution(solution)[0] for solution in results.race.values()],
            },
            "seconds": seconds,
        }
    )


def _pictures(results: Experiment) -> dict[str, tuple[str, float, np.ndarray]]:
    """Label with its note, exposure and linear values of each picture, by the name of its file."""
    pictures = {"target": ("Desired", 1.0, results.target)}
    labels = {"uncompensated": "Projected as it is", "compensated": "What is seen then"}
    for name, look in results.looks.items():
        note = f"{100 * look.error:.1f} % error"
        if name == "compensated":
            note += f", {100 * results.compensation.gain:.0f} % of the brightness"
        pictures[name] = f"{labels.get(name, 'Colours only')}\n{note}", look.exposure, look.seen
    pattern = results.compensation.pattern
    pictures["pattern"] = "The pattern that ltcl finds\nto be projected instead", 1.0, pattern
    exposure, direct = results.looks["uncompensated"].exposure, np.linalg.norm(results.bounces[0])
    for k, bounce in enumerate(results.bounces):
        times = float(direct / np.linalg.norm(bounce))
        label = (
            f"Bounce {k}\n{times:.1f} times as bright" if k else "Direct light\nas bright as above"
        )
        pictures[f"bounce_{k}"] = label, times * exposure, bounce
    return pictures
