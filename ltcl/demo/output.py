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
from ltcl.scenes import Scene

_VIEW = 800  # pixels along the longer side of a view


def write_pictures(found: Experiment, folder: Path) -> None:
    """Views and plots into `folder`, linear values into its subfolder ``linear``."""
    for name, picture in _linear(found).items():
        images.write(folder / "linear" / f"{name}.exr", picture)
    panels = _panels(found)
    for name, panel in panels.items():
        images.write(folder / f"{name}.png", panel.image[..., :3] * panel.image[..., 3:])
    title = f"Solving for the {COLOURS[found.worst]} light, \u03c1(R) = {_rho(found):.2f}"
    plots.save(plots.convergence(found.race, RTOL, title), folder / "convergence.png")
    sheet = plots.Sheet(
        title="A picture projected into a coloured corner",
        subtitle=_subtitle(found),
        large=[panels[name] for name in ("target", "uncompensated", "compensated")],
        medium=[panels[name] for name in ("colours_only", "pattern")],
        small=[panel for name, panel in panels.items() if name.startswith("bounce")],
        solutions=found.race,
        rtol=RTOL,
        plot_title=title,
    )
    plots.save(plots.contact_sheet(sheet), folder / "contact_sheet.png")


def report_of(found: Experiment, seconds: dict[str, float]) -> dict[str, Any]:
    """What goes into report.json, as plain data."""
    scene, compensation = found.scene, found.compensation
    total = float(np.linalg.norm(found.uncompensated.seen))
    bounces = [found.separation.direct, *found.separation.bounces]
    return report.plain(
        {
            "versions": report.versions(),
            "device": report.device(found.T.device),
            "scene": {
                "grid": scene.grid,
                "pixels": len(scene.area),
                "albedo": {wall.name: albedo for wall, albedo in zip(scene.walls, ALBEDO, strict=True)},
            },
            "spectral_radius": {
                colour: channel.spectral_radius
                for colour, channel in zip(COLOURS, found.analysis.channels, strict=True)
            },
            "analysis": found.analysis.to_dict(),
            "target": {"mist": found.target.mist},
            "errors": {
                "uncompensated": found.uncompensated.error,
                "colours_only": found.colours_only.error,
                "compensated": found.compensated.error,
            },
            "exposure_of_views": {name: exposure for name, (_, _, exposure) in _captions(found).items()},
            "compensation": {
                "gain": compensation.gain,
                "clipped": compensation.clipped,
                "channels": report.solution(compensation.solution),
            },
            "bounces": [
                {"bounce": k, "share": float(np.linalg.norm(part)) / total, "error": error}
                for k, (part, error) in enumerate(zip(bounces, found.bounce_errors, strict=True))
            ],
            "convergence": {
                "channel": COLOURS[found.worst],
                "methods": [report.solution(solution)[0] for solution in found.race.values()],
            },
            "seconds": seconds,
        }
    )


def _linear(found: Experiment) -> dict[str, np.ndarray]:
    bounces = [found.separation.direct, *found.separation.bounces]
    return {
        "target": found.target.picture,
        "uncompensated": found.uncompensated.seen,
        "colours_only": found.colours_only.seen,
        "pattern": found.compensation.pattern,
        "compensated": found.compensated.seen,
        **{f"bounce_{k}": part for k, part in enumerate(bounces)},
    }


def _panels(found: Experiment) -> dict[str, plots.Panel]:
    """Every picture as the viewer in front of the corner sees it, by the name of its file."""
    coverage = found.scene.view(np.ones(found.scene.grid), size=_VIEW, supersample=2)[..., None]
    linear = _linear(found)
    panels = {}
    for name, (label, note, exposure) in _captions(found).items():
        view = _view(found.scene, exposure * linear[name], coverage)
        panels[name] = plots.Panel(label, note, view)
    return panels


def _view(scene: Scene, picture: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """(H, W, 4): the walls' light, and how much of each pixel they cover."""
    view = scene.view(picture, size=_VIEW, supersample=2)
    return np.concatenate([view / np.maximum(coverage, 1e-6), coverage], axis=-1)


def _captions(found: Experiment) -> dict[str, tuple[str, str, float]]:
    """Label, note and exposure of each picture."""
    mist = found.target.mist
    captions = {"target": ("Desired", f"{100 * mist:.0f} % mist added" if mist >= 0.005 else "", 1.0)}
    for name, label in (
        ("uncompensated", "As it is"),
        ("compensated", "Compensated"),
        ("colours_only", "Colours only"),
    ):
        look = getattr(found, name)
        shown = "" if name == "colours_only" else "shown "  # its panel has less room
        note = f"{100 * look.error:.1f} % error, {shown}\u00d7 {look.exposure:.2g}"
        captions[name] = (label, note, look.exposure)
    captions["pattern"] = ("Pattern", "what is projected", 1.0)
    parts = [found.separation.direct, *found.separation.bounces]
    strength = [float(np.linalg.norm(part)) for part in parts]
    for k, part in enumerate(strength):
        label = f"Bounce {k}" if k else "Direct light"
        times = strength[0] / part
        captions[f"bounce_{k}"] = (label, f"\u00d7 {times:.1f}", times * found.uncompensated.exposure)
    return captions


def _rho(found: Experiment) -> float:
    return found.analysis.channels[found.worst].spectral_radius


def _subtitle(found: Experiment) -> str:
    solutions = found.compensation.solution
    steps = solutions if isinstance(solutions, tuple) else (solutions,)
    products = " + ".join(str(solution.products) for solution in steps)
    return (
        f"Bounces undone in {products} products, at {100 * found.compensation.gain:.0f} % of the wanted "
        f"brightness; \u03c1(R) = {_rho(found):.2f} in {COLOURS[found.worst]}, "
        "where the plain iteration diverges."
    )
