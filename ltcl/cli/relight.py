# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl relight`: the picture that a camera will see under a pattern."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ltcl.cli import loading, options, panels, pictures
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument
from ltcl.cli.reports.pictures import RelightReport, RelitPicture
from ltcl.cli.tables import table
from ltcl.tasks import relighting


@command(options.file_options, options.picture_options)
def relight(
    context: Context,
    transport: options.TransportFile,
    pattern: Annotated[list[Path], argument("PATTERN", "Pictures of patterns.")],
    out: options.OutFolder,
    on_dark: options.OnDark = "mask",
    device: options.DeviceName = None,
) -> Answer:
    """Show the picture that the camera will see when PATTERN is projected.

    With a TRANSPORT of 'ltcl acquire' a PATTERN of integers, as .png, holds the codes for its
    projector, and the result is what the pattern adds to the ambient light.

    Writes pictures exactly as .exr, and for viewing as .png at one exposure, which relight.json
    names.
    """
    T = loading.load(context, transport, notes_dark=False)
    setup = loading.load_setup(transport) or loading.setup_of_several(T)
    owner = "the projector" if T.scene is T else "the picture of all projectors side by side"
    patterns = pictures.read_all(context, pattern, T.grid, owner, setup)
    relit = {}
    for name, light in patterns.items():
        relit[name] = relighting.relight(T, light)
    report = RelightReport(
        folder=out,
        **loading.heading(context, transport, T),
        exposure=panels.exposure(*relit.values()),
        pictures=[],
    )
    rows = []
    with pictures.fill(out) as folder:
        for (name, picture), path in zip(relit.items(), pattern, strict=True):
            label = f"{path.name}, relit"
            panel = panels.linear_panel(picture, label, report.exposure)
            files = panels.write(folder, f"{name}_relit", picture, panel)
            brightest = float(picture.max())
            entry = RelitPicture(file=path, brightest=brightest, exr=files.exr, png=files.png)
            report.pictures.append(entry)
            rows.append((path.name, entry.brightest, entry.exr))
        pictures.write_report(folder, report)
    lines = [
        table(("pattern", "brightest in picture", "picture"), rows),
        f"\npictures as .exr and .png in {out}",
        loading.compression_caveat("they are", T),
    ]
    return Answer(report, lines)
