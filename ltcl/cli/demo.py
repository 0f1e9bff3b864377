# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl demo`: the main result, on this machine, without hardware."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import console, options
from ltcl.cli.command import Answer, Context
from ltcl.device import open_device

_Size = Annotated[int, options.option("Patches along a wall; the projector gets 3 N^2 pixels.", min=4)]
_LOOKS = {
    "uncompensated": "projected as it is",
    "colours_only": "wall colours undone, bounces left",
    "compensated": "compensated",
}


def demo(
    context: Context, out: options.Out = Path("ltcl-demo"), size: _Size = 36, device: options.Device = None
) -> Answer:
    """Compensate a picture in a coloured room corner: no hardware, no download, half a minute.

    Fills DIR with what is desired, what the walls would make of it, the pattern, the compensated result, the
    bounces of light, a convergence plot, a report and a contact sheet of all that.
    """
    opened = open_device(device)
    from ltcl import demo  # imports OpenCV and matplotlib

    def progress(step: str, *_: Any) -> None:
        context.progress(step, demo.STEPS.index(step), len(demo.STEPS))

    found = demo.run(out, size, device=opened, progress=progress)
    data = {"folder": found.folder, "files": found.files, **found.report}
    return Answer(data, partial(_show, data))


def _show(data: dict[str, Any]) -> None:
    rows = [(text, console.percent(data["errors"][look])) for look, text in _LOOKS.items()]
    console.table(("what the viewer sees", "error"), rows)
    typer.echo()
    solves = data["compensation"]["channels"] + data["convergence"]["methods"]
    rows = [[solve[name] for name in ("method", "status", "products", "residual")] for solve in solves]
    console.table(("method", "ended", "products", "residual"), rows)
    sheet = data["folder"] / "contact_sheet.png"
    typer.echo(f"\n{len(data['files'])} files in {data['folder']}; look at {sheet}")
