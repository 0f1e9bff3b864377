# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl separate`: direct light and bounces of pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL import Image

from ltcl import checks
from ltcl.cli import loading, options, panels, pictures
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import option
from ltcl.cli.reports.parts import Solve, solves
from ltcl.cli.reports.pictures import LightPart, SeparatedPicture, SeparateReport
from ltcl.cli.tables import percent, table
from ltcl.tasks import separation

# A part that can be amplified by this factor is shown a second time on the contact sheet.
MIN_AMPLIFICATION = 4
COLUMNS = ("picture", "part", "share of light", "products", "residual")


@command(*options.TASK_OPTIONS)
def separate(
    context: Context,
    transport: options.TransportFile,
    picture: options.Pictures,
    out: options.OutFolder,
    bounces: Annotated[int, option("Number of indirect bounces to separate.", min=0)] = 4,
) -> Answer:
    """Split PICTURE, taken of the scene under projector light, into direct light and bounces.

    Writes direct, indirect, bounce_1, bounce_2, ... and the rest exactly as .exr (measured ones may
    be a little negative), and for viewing as .png, all at one exposure, which separate.json names;
    and separate.png with all of them. Several pictures get a folder each. Standard deviations by
    the noise of TRANSPORT, if that is known, are direct_std, bounce_1_std, ... and in separate.png.
    """
    T = loading.load(context, transport)
    settings = loading.solver_settings(context, T, separation.RTOL, bounces + 1)
    photographs = pictures.read_all(context, picture, T.camera_grid, "the camera", upright=False)
    report = SeparateReport(
        folder=out,
        **loading.heading(context, transport, T, rtol=settings["rtol"]),
        exposure=panels.exposure(*photographs.values()),
        pictures=[],
    )
    writer = PartsWriter(
        factor=report.exposure,
        has_std=loading.has_std(T, settings),
        has_folders=len(photographs) > 1,
    )
    with pictures.fill(out) as folder:
        names = context.progress.each([*photographs])
        for name, path in zip(names, picture, strict=True):
            photograph = photographs[name]
            result = separation.separate(T, photograph, bounces, **settings)
            entry = writer.write(folder, name, path, photograph, result)
            report.pictures.append(entry)
        panels.contact_sheet(writer.sheet).save(folder / "separate.png")
        pictures.write_report(folder, report)
    lines = [
        table(COLUMNS, _table_rows(report)),
        f"\neach part as .exr and .png in {out}; look at {out / 'separate.png'}",
        _inverse_error_line(report),
        *dict.fromkeys(picture.warning for picture in report.pictures),
        loading.compression_caveat("all of this is", T, context.options["exact"]),
    ]
    return Answer(report, lines)


@dataclass(kw_only=True)
class PartsWriter:
    """Writes the parts of picture after picture, and gathers the rows of the contact sheet."""

    # Exposure of the run.
    factor: float
    has_std: bool
    # Whether each picture has a folder of its own.
    has_folders: bool
    sheet: list[list[Image.Image]] = field(default_factory=list)

    def write(
        self, folder: Path, name: str, path: Path, photograph: np.ndarray, result: Any
    ) -> SeparatedPicture:
        """Write all parts of a picture, and return its report."""
        light = _parts(result)
        deviations: dict[str, np.ndarray] = {}
        if self.has_std:
            deviations = _deviations(result)
        solved = dict(zip(_solved_names(result), result.solutions, strict=True))
        whole = _mean(photograph)
        parts = []
        shown = [panels.linear_panel(photograph, name, self.factor)]
        shown_std = []
        for label, picture in light.items():
            place = f"{name}/{label}" if self.has_folders else label
            panel = panels.linear_panel(picture, label, self.factor)
            shown.append(panel)
            files = panels.write(folder, place, picture, panel)
            share = None
            if whole:
                share = _mean(picture) / whole
            entry = LightPart(
                part=label,
                exr=files.exr,
                png=files.png,
                lowest=float(picture.min()),
                share=share,
                channels=solves(solved.get(label, ())),
            )
            if label in deviations:
                std = deviations[label]
                entry.std, panel = panels.write_std(folder, place, std, self.factor)
                shown_std.append(panel)
            parts.append(entry)
        rows = [shown[:3], shown[3:], self._amplified_panels(light), shown_std]
        self.sheet += filter(None, rows)
        return SeparatedPicture(
            file=path,
            transport_error=result.transport_error,
            warning=result.warning,
            parts=parts,
        )

    def _amplified_panels(self, light: dict[str, np.ndarray]) -> list[Image.Image]:
        """Draw dim parts once more, amplified."""
        amplified = []
        for label, picture in light.items():
            times, panel = panels.amplified_panel(picture, label, self.factor)
            if times >= MIN_AMPLIFICATION:
                amplified.append(panel)
        return amplified


def _solved_names(result: Any) -> list[str]:
    """Name the parts that are solved for."""
    return ["direct", *_bounces(result)]


def _parts(result: Any) -> dict[str, np.ndarray]:
    return {
        "direct": result.direct,
        "indirect": result.indirect,
        **_bounces(result),
        "rest": result.rest,
    }


def _bounces(result: Any) -> dict[str, np.ndarray]:
    return {f"bounce_{number}": bounce for number, bounce in enumerate(result.bounces, 1)}


def _deviations(result: Any) -> dict[str, np.ndarray]:
    deviations = [result.std.direct, *result.std.bounces]
    return dict(zip(_solved_names(result), deviations, strict=True))


def _mean(picture: np.ndarray) -> float:
    return float(picture.mean(dtype=np.float64))


def _table_rows(report: SeparateReport) -> list[list[Any]]:
    rows = []
    for picture in report.pictures:
        for part in picture.parts:
            products = sum(solve.products for solve in part.channels)
            row = [picture.file.name, part.part, percent(part.share, 4)]
            row += [products or None, _largest_residual(part.channels)]
            rows.append(row)
    return rows


def _largest_residual(solved: list[Solve]) -> float | None:
    """Return the largest residual of solves whose error is not bounded otherwise."""
    residuals = [solve.residual for solve in solved if solve.error is None]
    return max(residuals, default=None)


def _inverse_error_line(report: SeparateReport) -> str | None:
    """Tell the largest error of all solves by an inverse, if there was one."""
    errors = []
    for picture in report.pictures:
        for part in picture.parts:
            errors += [solve.error for solve in part.channels if solve.error is not None]
    if not errors:
        return None
    worst = 100 * float(checks.upwards(max(errors)))
    return f"the relative error of each part by the inverse is at most {worst:.2g} %"
