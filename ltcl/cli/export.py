# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl export`: scans as static files for other software."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ltcl import store
from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, option
from ltcl.cli.reports.export import ExportedProjectorReport, ExportReport, MapLossReport
from ltcl.device import open_device

FORMATS = ("maps", "png", "obj", "mpcdi", "mpcdi1", "cube")
REMARK = "light between walls depends on the picture, and is not in this file"
README = "README.txt"


def parse_format(text: str) -> str:
    """Parse a name of a format."""
    if text not in FORMATS:
        known = ", ".join(FORMATS)
        raise typer.BadParameter(f"{text!r} is not a format; choose one of {known}")
    return text


@command()
def export(
    context: Context,
    scans: Annotated[
        list[Path],
        argument(
            "SCAN",
            "Store or folder of 'ltcl acquire run', or folder of 'ltcl acquire import'; several of "
            "one camera, one for each projector, or the folder of all of them.",
        ),
    ],
    out: options.OutFolder,
    formats: Annotated[
        list[str] | None,
        option(
            "Kind of files: maps (EXR, NPZ, OpenCV's remap), png (blend and black masks), obj "
            "(warp mesh), mpcdi (2.0), mpcdi1 (1.0), or cube (response and colours); several, each "
            "with its own --format. Default: all.",
            "--format",
            parser=parse_format,
            metavar="FORMAT",
        ),
    ] = None,
    no_error: Annotated[
        bool,
        option(
            "Do not measure what these files lose, which takes a compensation of each SCAN.",
            "--no-error",
        ),
    ] = False,
    device: options.DeviceName = None,
) -> Answer:
    """Write what SCAN tells as static files for other software: maps, masks, MPCDI, mesh, colours.

    They bring each pixel to its place, share light between projectors, and undo response and
    colours. Light between walls depends on the picture, which no such file can hold: OUT/README.txt
    tells the error by maps alone beside that of ltcl.
    """
    from ltcl.files import fill_folder
    from ltcl.show.export import read_scans, share_light

    chosen_formats = formats or list(FORMATS)
    context.progress("reading scans")
    sources = read_scans(scans)
    projectors = share_light(sources)
    losses: list[MapLossReport | None] = [None] * len(sources)
    if not no_error:
        losses = [_measure_loss(context, source.store, device) for source in sources]
    names = [projector.name for projector in projectors]
    remark = f"{REMARK}; {_describe_losses(names, losses)}"
    with fill_folder(out) as temporary:
        files = _write_files(temporary, projectors, chosen_formats, remark)
        text = "\n".join(_readme(projectors, remark, files)) + "\n"
        (temporary / README).write_text(text, encoding="utf-8")
    reports = []
    for source, projector, loss in zip(sources, projectors, losses, strict=True):
        reports.append(
            ExportedProjectorReport(
                scan=source.path,
                name=projector.name,
                grid=projector.grid,
                seen=float(projector.seen.mean()),
                shared=float(np.mean(projector.blend[projector.seen] < 1.0 - 1e-3)),
                loss=loss,
            )
        )
    report = ExportReport(
        folder=out,
        camera_grid=projectors[0].camera_grid,
        projectors=reports,
        files=[*files, README],
    )
    return Answer(report, [*(str(out / file) for file in report.files), remark])


def _measure_loss(context: Context, path: Path | None, device: str | None) -> MapLossReport | None:
    """Measure what static files lose of a stored transport; None if there is none, or no square."""
    from ltcl.show.export import MapLoss

    if path is None:
        return None
    context.progress(f"what maps lose of {path}")
    T = store.load(path, on_dark="mask", device=open_device(device))
    if not T.is_square:
        return None
    return MapLossReport.from_attributes(MapLoss.measure(T))


def _describe_losses(names: Sequence[str], losses: Sequence[MapLossReport | None]) -> str:
    errors = []
    for name, loss in zip(names, losses, strict=True):
        if loss is None:
            continue
        of_projector = f"{name} " if len(losses) > 1 else ""
        errors.append(
            f"{of_projector}{_percent(loss.maps)} by maps alone, {_percent(loss.direct)} with "
            f"direct light undone, {_percent(loss.ltcl)} by ltcl"
        )
    if not errors:
        return "how much that is was not measured"
    return "error of a landscape on the wall, as T predicts it: " + "; ".join(errors)


def _percent(error: float) -> str:
    return f"{100 * error:.1f} %"


def _write_files(
    folder: Path, projectors: Sequence[Any], formats: Sequence[str], remark: str
) -> list[str]:
    """Write all files; return their names."""
    from ltcl.show import export

    files: list[str] = []
    for projector in projectors:
        if "maps" in formats:
            files += export.write_maps(folder, projector)
        if "png" in formats:
            files += export.write_masks(folder, projector)
        if "obj" in formats:
            files += export.write_mesh(folder, projector, remark)
        if "cube" in formats:
            files += export.write_cubes(folder, projector, remark)
    for name, version in (("mpcdi", "2.0"), ("mpcdi1", "1.0")):
        if name in formats:
            files.append(f"projectors_{version}.mpcdi" if name == "mpcdi1" else "projectors.mpcdi")
            export.write_mpcdi(folder / files[-1], projectors, remark, version)
    return files


def _readme(projectors: Sequence[Any], remark: str, files: Sequence[str]) -> list[str]:
    height, width = projectors[0].camera_grid
    lines = [
        "Written by 'ltcl export'; docs/guide/shows.md describes the files.",
        f"Camera: {width} x {height} pixels (width x height).",
    ]
    for projector in projectors:
        height, width = projector.grid
        lines.append(f"{projector.name}: {width} x {height} pixels.")
    return [*lines, f"{remark[0].upper()}{remark[1:]}.", "", *files]
