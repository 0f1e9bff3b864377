# SPDX-License-Identifier: BSD-3-Clause
"""A folder or a video for `ltcl compensate`: its patterns, how many, how fast, how well."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ltcl.cli import console
from ltcl.cli.command import Answer, Context
from ltcl.errors import FileError, InputError
from ltcl.transport import Transport

if TYPE_CHECKING:
    from ltcl.batch import CompensatedFrames

_OPTIONS = ("batch", "resume", "frames", "video", "fps", "format", "appearance")
_MANY = 0.01  # part of a pattern clipped from which advice is given


def source(paths: Sequence[Path], options: dict[str, Any]) -> Path | None:
    """The folder or video, which must be the only input; None where there are pictures."""
    from ltcl.images.frames import is_frames

    for path in paths:
        if not path.exists():
            raise FileError(f"{path}: no such file or folder")
    films = [path for path in paths if is_frames(path)]
    if films and len(paths) > 1:
        text = f"holds frames, and there are {len(paths) - 1} more inputs; it must be the only one"
        raise InputError(f"{films[0]}: {text}")
    for name in _OPTIONS:
        if not films and options[name] not in (None, False):
            raise InputError(f"--{name} is given, but {paths[0]} is a picture; it is for a folder or a video")
    return films[0] if films else None


def run(
    context: Context, T: Transport, film: Path, text: dict[str, Any], settings: dict[str, Any], note: str
) -> Answer:
    """Patterns of all frames into --out."""
    from ltcl.batch import compensate_frames

    asked = {name: context.options[name] for name in (*_OPTIONS, "resize", "encoding")} | settings
    arguments = {name: value for name, value in asked.items() if value is not None}
    out = context.options["out"]
    try:
        found = compensate_frames(T, film, out, progress=context.progress, **arguments)
    except KeyboardInterrupt:
        count = f"{context.progress.done:.0f} frame(s) are done and stay in {out}"
        raise KeyboardInterrupt(f"interrupted; {count}; --resume goes on from there") from None
    names = ("video", "gain", "solved", "seconds", "frames_per_second", "transport_error")
    data = {"folder": out, **text, "source": film, **{name: getattr(found, name) for name in names}}
    data |= {name: dataclasses.asdict(getattr(found, name)) for name in ("worst", "most_clipped")}
    data["frames"] = [dataclasses.asdict(record) for record in found.records]
    return Answer(data, partial(_show, found, note))


def _show(found: CompensatedFrames, note: str) -> None:
    """Print what came out, and on stderr what would help."""
    worst, most = found.worst, found.most_clipped
    pace = f"{found.frames_per_second:.1f}" if found.solved else None
    error, clipped = f"{100 * worst.error:.2f} %", f"{100 * most.clipped:.1f} %"
    cells = (len(found.records), found.solved, pace, found.gain, error, worst.number, clipped, most.number)
    columns = (
        "frames",
        "of this run",
        "a second",
        "gain",
        "worst error",
        "in frame",
        "most clipped",
        "in frame",
    )
    console.table(columns, [cells])
    also = "" if found.video is None else f", as a video in {found.video}"
    typer.echo(f"\npatterns and frames.json in {found.folder}{also}" + (f"\n{note}" if note else ""))
    if most.clipped > _MANY:
        count = sum(record.clipped > _MANY for record in found.records)
        frame = f"frame {most.number} ({most.name}) most; try a --gain below {found.gain:.3g}"
        console.note(f"{count} frame(s) ask for light beyond the projector's, {frame}")
