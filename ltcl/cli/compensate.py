# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`: patterns for pictures, with one transport or with many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL import Image

from ltcl.cli import compensation, loading, options, panels, pictures, scenes
from ltcl.cli.command import Answer, Context, command, note
from ltcl.cli.failure import UsageError
from ltcl.cli.options import argument, option
from ltcl.cli.reports.parts import PictureWithStd, Solve, solves
from ltcl.cli.reports.pictures import CompensatedPicture, CompensateReport
from ltcl.cli.tables import percent, table
from ltcl.errors import InputError, LtclError
from ltcl.tasks.compensation import compensate as compensate_picture

sharing_option = partial(option, panel="Sharing the work")
# Share of a picture out of reach from which advice is given.
ADVICE_SHARE = 0.01
# Pictures of which a contact sheet shows the first ones.
MAX_SHEET_ROWS = 12
ADVICE = {
    "dark": "; where the pattern is at 1 a lower --gain helps, or --gain auto",
    "dark at the largest gain": "; a smaller --loss, or --weights, brings it nearer",
    "bright": ", by bounces or the background; brighten its dark parts",
}
COLUMNS = ("picture", "method", "products", "gain", "clipped", "error", "pattern")


def sharing_options(
    mpi: Annotated[
        bool,
        sharing_option(
            "Share each solve between the ranks of 'mpiexec -n 2 ltcl compensate ... --mpi'.",
            "--mpi",
        ),
    ] = False,
    transports: Annotated[
        str | None,
        sharing_option(
            "Glob pattern of transports, instead of TRANSPORT, such as "
            "'scans/*.zarr'; DIR gets a folder for each.",
            metavar="PATTERN",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        sharing_option(
            "Workers for --transports: local processes, one for each GPU, or "
            "the ADDRESS of a Dask scheduler.",
            metavar="local|ADDRESS",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        sharing_option("Number of processes of --cluster local.", metavar="N", min=1),
    ] = None,
) -> None:
    """Options that share the work."""


@command(compensation.target_options, *options.TASK_OPTIONS, sharing_options)
def compensate(
    context: Context,
    transport: options.TransportFile,
    out: options.OutFolder,
    picture: Annotated[
        list[Path] | None, argument("PICTURE", "Pictures: .png, .jpg, .tif, .bmp or .exr.")
    ] = None,
) -> Answer:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern, how the scene will look under it and what is out of the
    projector's reach, exactly as .exr and as .png; all in compensate.png, and compensate.json. The
    .png of a pattern has the codes for the projector, pixel for pixel: those of the measured
    response with a TRANSPORT of 'ltcl acquire', else sRGB. The others are for viewing, at one
    exposure, which compensate.json names. Standard deviations by the noise of TRANSPORT, if that
    is known, are NAME_pattern_std and NAME_appearance_std.

    The ambient light of a TRANSPORT of 'ltcl acquire' is the background, and the gain is auto.

    'ltcl film' is for videos and folders of frames.
    """
    paths = [] if picture is None else picture
    has_scenes = context.options["transports"] is not None
    if has_scenes:
        # The first argument is a picture, too.
        paths = [transport, *paths]
    if not paths:
        raise UsageError("Missing argument 'PICTURE'.")
    _check_sharing(context)
    if has_scenes:
        scenes.check_pictures(paths)
    _check_pictures(paths)
    if has_scenes:
        return scenes.compensate_scenes(context, paths, out, compensate_pictures)
    return compensate_pictures(context, transport, paths, out)


def _check_pictures(paths: list[Path]) -> None:
    from ltcl.images.frames import is_frames

    for path in paths:
        if is_frames(path):
            raise InputError(f"{path}: holds frames; 'ltcl film' compensates them")


def _check_sharing(context: Context) -> None:
    """Refuse options that exclude one another."""
    asked = context.options
    if asked["mpi"]:
        for name in ("transports", "cluster"):
            if asked[name] is not None:
                raise InputError(f"--mpi is given, and --{name}; give one of them")
    for name in ("cluster", "workers"):
        if asked[name] is not None and asked["transports"] is None:
            raise InputError(
                f"--{name} is given, but --transports is not; "
                "workers share many transports, and 'ltcl film' shares frames"
            )


def compensate_pictures(
    context: Context, transport: Path, paths: Sequence[Path], out: Path
) -> Answer:
    """Write the patterns for all pictures into a folder, with their contact sheet."""
    job = compensation.prepare(context, transport)
    desired = pictures.read_all(context, paths, job.T.camera_grid, "the camera")
    report = CompensateReport(
        folder=out,
        **job.heading,
        pattern_png=job.pattern_codes,
        exposure=panels.exposure(*desired.values()),
        pictures=[],
    )
    writer = PictureWriter(
        job=job,
        factor=report.exposure,
        white=max(job.settings["bounds"][1], 0.0) or 1.0,
        has_std=loading.has_std(job.T, job.settings),
    )
    sheet = []
    rows = []
    with pictures.fill(out) as folder:
        names = context.progress.each([*desired])
        for name, path in zip(names, paths, strict=True):
            try:
                result = compensate_picture(job.T, desired[name], **job.settings)
            except LtclError as error:
                error.args = (f"{error} (compensating {path})",)
                raise
            entry, shown = writer.write(folder, name, path, desired[name], result)
            report.pictures.append(entry)
            sheet.append(shown)
            rows.append(_table_row(path, name, entry))
            _note_out_of_reach(path, entry, has_largest_gain=job.settings["gain"] == "auto")
        panels.contact_sheet(sheet[:MAX_SHEET_ROWS]).save(folder / "compensate.png")
        pictures.write_report(folder, report)
    lines = [
        table(COLUMNS, rows),
        f"\npatterns, appearances and light out of reach as .exr and .png in {out}",
        f"look at {out / 'compensate.png'}",
    ]
    return Answer(report, [*lines, *job.notes])


@dataclass(frozen=True, kw_only=True)
class PictureWriter:
    """Writes the files of one picture after the other."""

    job: compensation.CompensationJob
    # Exposure of the run.
    factor: float
    # Light that is white in the .png of a pattern.
    white: float
    has_std: bool

    def write(
        self, folder: Path, name: str, path: Path, desired: np.ndarray, result: Any
    ) -> tuple[CompensatedPicture, list[Image.Image]]:
        """Write all files of a picture; return its report and its row of the contact sheet."""
        # Appearances are compared with the picture that was asked for.
        appearance_factor = self.factor / result.gain
        seen = panels.to_srgb(result.appearance, appearance_factor)
        missing = panels.mark(seen, result.out_of_reach * appearance_factor)
        label = f"{name}, as predicted, error {100 * result.error:.2g} %"
        appearance_panel = panels.panel(seen, label)
        label = "out of reach: orange too dark, blue too bright"
        missing_panel = panels.panel(missing, label)
        row = [
            panels.linear_panel(desired, f"{name}, desired", self.factor),
            panels.linear_panel(result.pattern, f"{name}, pattern", 1 / self.white),
            appearance_panel,
            missing_panel,
        ]
        pattern = self._write_pattern(folder, name, result.pattern)
        files = panels.write(folder, f"{name}_appearance", result.appearance, appearance_panel)
        appearance = PictureWithStd(exr=files.exr, png=files.png)
        if self.has_std:
            std = result.std
            pattern.std, panel = panels.write_std(
                folder, f"{name}_pattern", std.pattern, 1 / self.white
            )
            row.append(panel)
            appearance.std, panel = panels.write_std(
                folder, f"{name}_appearance", std.appearance, appearance_factor
            )
            row.append(panel)
        entry = CompensatedPicture.from_attributes(
            result,
            file=path,
            too_dark=float(np.mean(result.out_of_reach > 0)),
            too_bright=float(np.mean(result.out_of_reach < 0)),
            channels=solves(result.solution),
            limited=solves(result.limited),
            pattern=pattern,
            appearance=appearance,
            out_of_reach=panels.write(
                folder, f"{name}_out_of_reach", result.out_of_reach, missing_panel
            ),
        )
        return entry, row

    def _write_pattern(self, folder: Path, name: str, pattern: np.ndarray) -> PictureWithStd:
        """Write the light of a pattern, and the codes that the projector has to get."""
        from ltcl import images

        place = folder / f"{name}_pattern"
        exr = place.with_suffix(".exr")
        png = place.with_suffix(".png")
        images.write(exr, pattern)
        setup = self.job.setup
        if setup is None:
            images.write(png, pattern / self.white, encoding="srgb")
        else:
            images.write(png, setup.codes(pattern), encoding="linear")
        return PictureWithStd(exr=exr.name, png=png.name)


def _table_row(path: Path, name: str, entry: CompensatedPicture) -> list[Any]:
    solved = all_solves(entry)
    methods = dict.fromkeys(solve.method for solve in solved)
    return [
        path.name,
        ", ".join(methods),
        sum(solve.products for solve in solved),
        entry.gain,
        percent(entry.clipped),
        percent(entry.error),
        f"{name}_pattern.png",
    ]


def all_solves(entry: CompensatedPicture) -> list[Solve]:
    """Return the solves without bounds and those within them, each once."""
    solved = [*entry.channels]
    for solve in entry.limited:
        if solve not in entry.channels:
            solved.append(solve)
    return solved


def _note_out_of_reach(path: Path, entry: CompensatedPicture, has_largest_gain: bool) -> None:
    shares = {"dark": entry.too_dark, "bright": entry.too_bright}
    for kind, share in shares.items():
        advice = ADVICE[kind]
        if kind == "dark" and has_largest_gain:
            advice = ADVICE["dark at the largest gain"]
        if share > ADVICE_SHARE:
            note(f"{path}: {100 * share:.0f} % of it stays too {kind}{advice}")
