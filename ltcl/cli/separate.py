# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl separate`: each bounce of light of a picture as a picture; `ltcl relight`: light under patterns."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ltcl import checks, report
from ltcl.cli import options, pictures, transports
from ltcl.cli.command import Answer, Context, command, percent, table


@command(options.file_options, options.transport_options, options.solve_options, options.picture_options)
def separate(
    context: Context,
    transport: options.Matrix,
    picture: options.Pictures,
    out: options.Out,
    bounces: Annotated[int, options.option("Indirect bounces to separate.", min=0)] = 4,
) -> Answer:
    """Split PICTURE, taken of the scene under projector light, into direct light and bounces.

    Writes direct, indirect, bounce_1, bounce_2, ... and the rest exactly as .exr (measured ones may be a
    little negative), and for the eye as .png, all at one exposure, which separate.json names; and
    separate.png with all of them. Several pictures get a folder each. Standard deviations by the noise of
    TRANSPORT, where that is known, are direct_std, bounce_1_std, ... and in separate.png.
    """
    from ltcl.separation import RTOL, separate

    T = transports.load(context, transport)
    settings = transports.solving(context, T, RTOL)
    images = pictures.read_all(context, picture, T.camera_grid, "the camera", upright=False)
    files, noisy = dict(zip(images, picture, strict=True)), transports.shows_noise(T, settings)
    factor, entries, sheet, rows, errors = pictures.exposure(*images.values()), [], [], [], []
    text = transports.heading(context, transport, T, rtol=settings["rtol"])
    text |= {"exposure": factor, "pictures": entries}
    with pictures.fill(out, text) as folder:
        for name in context.progress.each(list(images)):
            callback = transports.callback(context, T, settings, bounces + 1)
            result = separate(T, images[name], bounces, callback=callback, **settings)
            solved = ["direct", *(f"bounce_{k}" for k in range(1, len(result.bounces) + 1))]
            light = {"direct": result.direct, "indirect": result.indirect}
            light |= dict(zip(solved[1:], result.bounces, strict=True)) | {"rest": result.rest}
            solutions = dict(zip(solved, result.solutions, strict=True))
            std = dict(zip(solved, [result.std.direct, *result.std.bounces], strict=True)) if noisy else {}
            deviations, panels, facts = [], [pictures.panel(pictures.shades(images[name], factor), name)], []
            for component, picture_of in light.items():
                panels.append(pictures.panel(pictures.shades(picture_of, factor), component))
                place = f"{name}/{component}" if len(images) > 1 else component
                written = pictures.write(folder, place, picture_of, panels[-1])
                solves = report.solution(solutions[component]) if component in solutions else []
                share, lowest = _share(picture_of, images[name]), float(picture_of.min())
                facts.append({"part": component, **written, "share": share, "lowest": lowest})
                facts[-1]["channels"] = solves
                if component in std:
                    facts[-1]["std"], shown = pictures.deviation(folder, place, std[component], factor)
                    deviations.append(shown)
                errors += [solve["error"] for solve in solves if solve["error"] is not None]
                residual = max((each["residual"] for each in solves if each["error"] is None), default=None)
                products = sum(each["products"] for each in solves) or None
                rows.append((files[name].name, component, percent(share, 4), products, residual))
            entry = {"file": str(files[name]), "transport_error": result.transport_error}
            entries.append(entry | {"parts": facts})
            sheet += [panels[:3], panels[3:], pictures.amplified(light, factor), deviations]
        pictures.contact_sheet([row for row in sheet if row]).save(folder / "separate.png")
    lines: list[Any] = [table(("picture", "part", "share of light", "products", "residual"), rows)]
    lines.append(f"\neach part as .exr and .png in {out}; look at {out / 'separate.png'}")
    if errors:
        worst = 100 * float(checks.upwards(max(errors)))
        lines.append(f"the relative error of each part by the inverse is at most {worst:.2g} %")
    lines.append(transports.caveat("all of this is", T, context.options["exact"]))
    return Answer({"folder": out, **text}, lines)


def _share(light: np.ndarray, picture: np.ndarray) -> float | None:
    """Of the light of a picture, over pixels and three colours."""
    sums = [float(np.sum(each, dtype=np.float64)) * (1 if each.ndim == 3 else 3) for each in (light, picture)]
    return sums[0] / sums[1] if sums[1] else None


@command(options.file_options, options.picture_options)
def relight(
    context: Context,
    transport: options.Matrix,
    pattern: Annotated[list[Path], options.argument("PATTERN...", "Pictures of patterns.")],
    out: options.Out,
    on_dark: options.OnDark = "mask",
    device: options.Device = None,
) -> Answer:
    """Show what the camera will see when PATTERN is projected.

    With a TRANSPORT of 'ltcl acquire' a PATTERN of integers, as .png, holds the codes for its projector, and
    the result is what the pattern adds to the ambient light.

    Writes pictures exactly as .exr, and for the eye as .png at one exposure, which relight.json names.
    """
    from ltcl.acquisition import Setup
    from ltcl.relighting import relight

    T = transports.load(context, transport, dark_note=False)
    setup = Setup.of(transport) if transports.is_measured(transport) else None
    patterns = pictures.read_all(context, pattern, T.grid, "the projector", setup)
    light = {name: relight(T, each) for name, each in patterns.items()}
    factor, entries = pictures.exposure(*light.values()), []
    text = transports.heading(context, transport, T) | {"exposure": factor, "pictures": entries}
    with pictures.fill(out, text) as folder:
        for (name, picture), file in zip(light.items(), pattern, strict=True):
            panel = pictures.panel(pictures.shades(picture, factor), f"{file.name}, relit")
            facts = {"file": str(file), "brightest": float(picture.max())}
            entries.append(facts | pictures.write(folder, f"{name}_relit", picture, panel))
    rows = [(Path(entry["file"]).name, entry["brightest"], entry["exr"]) for entry in entries]
    lines = [table(("pattern", "brightest in picture", "picture"), rows)]
    lines += [f"\npictures as .exr and .png in {out}", transports.caveat("they are", T)]
    return Answer({"folder": out, **text}, lines)
