# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl demo`: the main result of ltcl, without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command, note
from ltcl.cli.options import option
from ltcl.cli.reports.program import DemoReport
from ltcl.cli.tables import percent, table
from ltcl.device import open_device

VIEW_LABELS = {
    "uncompensated": "projected as it is",
    "colours_only": "wall colours undone, bounces left",
}


@command()
def demo(
    context: Context,
    out: options.OutFolder = Path("ltcl-demo"),
    size: Annotated[
        int, option("Patches along a wall; the projector has 8 N x 24 N pixels.", min=4)
    ] = 32,
    device: options.DeviceName = None,
) -> Answer:
    """Compensate a picture in a coloured room corner: no hardware, no download, half a minute.

    Fills DIR, first with compensation.png, the look of the walls without compensation, the pattern,
    and the compensated result; a line tells when it is there. Then come the desired picture, the
    bounces of light, all of these as files of their own, a report and a contact sheet; with the
    extra plots also a plot of convergence.
    """
    opened = open_device(device)
    # It imports OpenCV.
    from ltcl import demo

    def show_step(step: str) -> None:
        context.progress(step, demo.STEPS.index(step), len(demo.STEPS))

    def announce(picture: Path) -> None:
        note(f"{picture} shows the compensated corner; its bounces follow")

    done = demo.run(out, size, device=opened, progress=show_step, announce=announce)
    report = DemoReport(folder=done.folder, files=list(done.files), **done.report)
    rows = []
    for view, error in done.report["errors"].items():
        rows.append((VIEW_LABELS.get(view, view), percent(error)))
    sheet = out / "contact_sheet.png"
    place = f"\n{len(done.files)} files in {out}; look at {sheet}"
    return Answer(report, [table(("what the viewer sees", "error"), rows), place])
