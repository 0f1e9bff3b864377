# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl film`: patterns for all frames of a video or a folder of pictures."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from ltcl.cli import compensation, options, scenes
from ltcl.cli.command import Answer, Context, command, note
from ltcl.cli.options import argument, check_writable_file, file_option, option
from ltcl.cli.reports.pictures import FilmReport, FrameReport
from ltcl.cli.tables import percent, table
from ltcl.errors import InputError
from ltcl.files import input_file

FRAMES_PANEL = "Frames"
frame_option = partial(option, panel=FRAMES_PANEL)
cluster_option = partial(option, panel="Cluster")
# Share of a pattern at a bound from which advice is given.
ADVICE_SHARE = 0.01
COLUMNS = ("frames", "of this run", "a second", "gain", "worst error", "most clipped")


def frame_options(
    batch: Annotated[
        int | None,
        frame_option("Number of frames solved at once. Default: 8.", min=1),
    ] = None,
    resume: Annotated[
        bool,
        frame_option("Continue the last run into DIR where it ended.", "--resume"),
    ] = False,
    frames: Annotated[
        int | None, frame_option("Only the first N frames.", metavar="N", min=1)
    ] = None,
    video: Annotated[
        Path | None,
        file_option(
            "Video of the patterns to write as well: .mkv or .avi, lossless; or "
            ".mp4, which changes their codes.",
            callback=check_writable_file,
            panel=FRAMES_PANEL,
        ),
    ] = None,
    fps: Annotated[
        float | None,
        frame_option("Frames per second of that video. Default: as the source, else 25."),
    ] = None,
    format: Annotated[
        Literal["png", "exr"] | None,
        frame_option(
            "Format of the patterns: png, 16 bits; or exr, the linear light. Default: png."
        ),
    ] = None,
    appearance: Annotated[
        bool,
        frame_option("Write how the scene will look, too.", "--appearance"),
    ] = False,
) -> None:
    """Options of the frames that are read and written."""


def cluster_options(
    cluster: Annotated[
        str | None,
        cluster_option(
            "Workers that solve: local processes, one for each GPU, or the "
            "ADDRESS of a Dask scheduler.",
            metavar="local|ADDRESS",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        cluster_option("Number of processes of --cluster local.", metavar="N", min=1),
    ] = None,
) -> None:
    """Options of a cluster."""


@command(frame_options, compensation.target_options, *options.TASK_OPTIONS, cluster_options)
def film(
    context: Context,
    transport: options.TransportFile,
    film: Annotated[Path, argument("FILM", "A video, or a folder of pictures.")],
    out: options.OutFolder,
) -> Answer:
    """Find the projector patterns that make a scene look like each frame of FILM.

    Writes the numbered patterns and frames.json batch by batch, with one gain for all frames.
    Ctrl-C keeps what is done, for --resume. The .png of a pattern has the codes for the projector:
    those of the measured response with a TRANSPORT of 'ltcl acquire', else sRGB.

    The ambient light of a TRANSPORT of 'ltcl acquire' is the background, and the gain is auto.

    With --cluster workers solve; docs/guide/cluster.md shows how.
    """
    from ltcl.images.frames import is_frames

    if not is_frames(film):
        # One that is missing is no picture either.
        input_file(film)
        problem = f"FILM is {film}; it must be a video or a folder"
        raise InputError(f"{problem}; 'ltcl compensate' is for pictures")
    job = compensation.prepare(context, transport)
    result = _compensate_frames(context, job, film, out)
    report = FilmReport.from_attributes(
        result,
        folder=out,
        **job.heading,
        pattern_png=job.pattern_codes,
        source=film,
        worst=FrameReport.from_attributes(result.worst),
        most_clipped=FrameReport.from_attributes(result.most_clipped),
        frames=[FrameReport.from_attributes(record) for record in result.records],
    )
    _note_clipped(report)
    return Answer(report, [*_lines(report), *job.notes])


def _compensate_frames(
    context: Context, job: compensation.CompensationJob, film: Path, out: Path
) -> Any:
    """Write the patterns of all frames."""
    from ltcl.batch import compensate_frames, manifest

    settings = {**job.settings}
    del settings["callback"]
    names = ("batch", "resume", "frames", "video", "fps", "format", "appearance")
    for name in (*names, "resize", "encoding"):
        settings[name] = context.options[name]
    if job.setup is not None:
        settings["codes"] = job.setup.codes
    arguments = {name: value for name, value in settings.items() if value is not None}
    try:
        with scenes.connect_cluster(context) as client:
            return compensate_frames(
                job.T, film, out, progress=context.progress, client=client, **arguments
            )
    except KeyboardInterrupt:
        # More than progress has told, if a batch was being written.
        count = f"{manifest.count(out)} frame(s) are done and stay in {out}"
        raise KeyboardInterrupt(f"interrupted; {count}; --resume goes on from there") from None


def _note_clipped(report: FilmReport) -> None:
    if report.most_clipped.clipped <= ADVICE_SHARE:
        return
    count = sum(frame.clipped > ADVICE_SHARE for frame in report.frames)
    most = f"frame {report.most_clipped.number} ({report.most_clipped.name}) most"
    advice = "a lower --gain helps where patterns are at 1"
    note(f"{count} frame(s) ask for light beyond the projector's, {most}; {advice}")


def _lines(report: FilmReport) -> list[str]:
    worst = report.worst
    most_clipped = report.most_clipped
    pace = None
    if report.solved:
        pace = f"{report.frames_per_second:.1f}"
    row = (
        len(report.frames),
        report.solved,
        pace,
        report.gain,
        f"{percent(worst.error)} in frame {worst.number}",
        f"{percent(most_clipped.clipped)} in frame {most_clipped.number}",
    )
    place = f"\npatterns and frames.json in {report.folder}"
    if report.video is not None:
        place += f", as a video in {report.video}"
    return [table(COLUMNS, [row]), place]
