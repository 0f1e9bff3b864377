# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl demo`: the main result, on this machine, without hardware."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import console, options
from ltcl.device import open_device

_SIZE = Annotated[
    int, typer.Option(metavar="N", min=4, help="Patches along a wall; the projector gets 3 N^2 pixels.")
]


def run(
    out: options.Out = Path("ltcl-demo"),
    size: _SIZE = 36,
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Compensate a picture in a coloured room corner: no hardware, no download, half a minute.

    Fills DIR with what is desired, what the walls would make of it, the pattern, the compensated result, the
    bounces of light, a convergence plot, a report and a contact sheet of all that.
    """
    opened = open_device(device)
    from ltcl import demo  # brings OpenCV and matplotlib

    with console.Steps(len(demo.STEPS), patient=False) as steps:
        done = demo.run(out, size, device=opened, progress=steps.item)
    if json:
        console.answer({"folder": done.folder, "files": done.files, **done.report})
        return
    _show(done.report)
    typer.echo(f"\n{len(done.files)} files in {done.folder}; look at {done.folder / 'contact_sheet.png'}")


def _show(report: dict[str, Any]) -> None:
    errors = report["errors"]
    console.table(
        ("what the viewer sees", "error"),
        [
            ("projected as it is", _percent(errors["uncompensated"])),
            ("wall colours undone, bounces left", _percent(errors["colours_only"])),
            ("compensated", _percent(errors["compensated"])),
        ],
    )
    typer.echo()
    console.table(
        ("colour", "rho(R)", "method", "products", "seconds"),
        [
            (colour, radius, channel["method"], channel["products"], round(channel["seconds"], 3))
            for (colour, radius), channel in zip(
                report["spectral_radius"].items(), report["compensation"]["channels"], strict=True
            )
        ],
    )
    typer.echo()
    console.table(
        (f"method, on {report['convergence']['channel']}", "ended", "products", "best residual"),
        [(m["method"], m["status"], m["products"], m["residual"]) for m in report["convergence"]["methods"]],
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
