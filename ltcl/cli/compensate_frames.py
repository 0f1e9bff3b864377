# SPDX-License-Identifier: BSD-3-Clause
"""A folder or a video that `ltcl compensate` is given: its patterns, how far, how fast, how well."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from ltcl.cli import console
from ltcl.errors import FileError, InputError
from ltcl.transport import Transport

if TYPE_CHECKING:
    from ltcl.batch import CompensatedFrames

_MANY = 0.01  # of a pattern clipped: worth a word


def source(paths: Sequence[Path], film: dict[str, Any]) -> Path | None:
    """The folder or video among the pictures; None where there is none.

    Raises
    ------
    InputError
        It is not alone, or there is none and an option in `film` asks for one; nothing is there.
    """
    from ltcl.images.frames import is_frames

    _require_there(paths)
    found = [path for path in paths if is_frames(path)]
    if found and len(paths) > 1:
        raise InputError(
            f"{found[0]}: holds frames, and there are {len(paths) - 1} more inputs; it must be the only one"
        )
    for name, value in film.items():
        if not found and value not in (None, False):
            raise InputError(f"--{name} is given, but {paths[0]} is a picture; it is for a folder or a video")
    return found[0] if found else None


def _require_there(paths: Sequence[Path]) -> None:
    for path in paths:
        try:
            path.stat()
        except FileNotFoundError:
            raise FileError(f"{path}: no such file or folder") from None
        except (OSError, ValueError):  # no permission, a NUL byte: whoever opens it says so
            continue


def run(T: Transport, path: Path, out: Path, settings: dict[str, Any]) -> CompensatedFrames:
    """Patterns of all frames into `out`; `settings` are those of `ltcl.batch.compensate_frames`."""
    from ltcl.batch import compensate_frames

    given = {name: value for name, value in settings.items() if value is not None}
    with console.Frames() as progress:
        try:
            return compensate_frames(T, path, out, progress=lambda _, *done: progress(*done), **given)
        except KeyboardInterrupt:
            console.note(f"{progress.done} frame(s) are done and stay in {out}; --resume goes on from there")
            raise


def entry(path: Path, done: CompensatedFrames) -> dict[str, Any]:
    """What ``--json`` says of the frames."""
    return {
        "source": path,
        "video": done.video,
        "gain": done.gain,
        "solved": done.solved,
        "seconds": done.seconds,
        "frames_per_second": done.frames_per_second,
        "transport_error": done.transport_error,
        "worst": dataclasses.asdict(done.worst),
        "most_clipped": dataclasses.asdict(done.most_clipped),
        "frames": [dataclasses.asdict(record) for record in done.records],
    }


def show(done: CompensatedFrames, told: str, auto: bool = False) -> None:
    """Print what came out, what is `told` of the errors, and on stderr what would help."""
    worst, most = done.worst, done.most_clipped
    console.table(
        ("frames", "of this run", "a second", "gain", "worst error", "in frame", "most clipped", "in frame"),
        [
            (
                len(done.records),
                done.solved,
                f"{done.frames_per_second:.1f}" if done.solved else None,
                done.gain,
                f"{100 * worst.error:.2f} %",
                worst.number,
                f"{100 * most.clipped:.1f} %",
                most.number,
            )
        ],
    )
    also = "" if done.video is None else f", as a video in {done.video}"
    typer.echo(f"\npatterns and frames.json in {done.folder}{also}")
    if told:
        typer.echo(told)
    if most.clipped > _MANY:
        count = sum(record.clipped > _MANY for record in done.records)
        advice = "" if auto else f"; try a --gain below {done.gain:.3g}"
        console.note(
            f"{count} frame(s) ask for light beyond the projector's, frame {most.number} ({most.name}) "
            f"most{advice}"
        )
