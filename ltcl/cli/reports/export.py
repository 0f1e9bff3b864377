# SPDX-License-Identifier: BSD-3-Clause
"""Report of `ltcl export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ltcl.cli.reports.parts import Files, FolderReport, ProjectorGrid
from ltcl.cli.reports.report import Report


@dataclass(kw_only=True)
class MapLossReport(Report):
    """Relative errors of a landscape on the wall."""

    maps: Annotated[float, "With maps alone."]
    direct: Annotated[float, "With the direct light of each pixel undone, too."]
    ltcl: Annotated[float, "With `ltcl compensate`."]


@dataclass(kw_only=True)
class ExportedProjectorReport(Report):
    """A projector."""

    scan: Annotated[Path, "Its scan."]
    name: Annotated[str, "Its name in the files."]
    grid: ProjectorGrid
    seen: Annotated[float, "Share of its pixels that the camera sees."]
    shared: Annotated[float, "Share of these that another projector lights, too."]
    loss: Annotated[
        MapLossReport | None, "What the files lose; null without a transport of bounces."
    ]


@dataclass(kw_only=True)
class ExportReport(FolderReport):
    """`ltcl export`."""

    camera_grid: Annotated[tuple[int, int], "Height and width of the camera."]
    projectors: Annotated[list[ExportedProjectorReport], "One for each SCAN."]
    files: Files
