# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl show`: the patterns of a folder, full screen on the projector."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import options
from ltcl.cli.command import Answer, Context
from ltcl.errors import InputError

_Folder = Annotated[Path, options.argument("FOLDER", "Pictures, or an acquisition with its patterns.")]
_Display = Annotated[int, options.option("Number of the display, from 0.", metavar="N", min=0)]
_Every = Annotated[float | None, options.option("Next picture after so many seconds.", metavar="SECONDS")]
_Arrival = Annotated[
    bool, options.option("Next pattern when its photograph is in the folder of the acquisition.", "--arrival")
]


def show(
    context: Context, folder: _Folder, display: _Display = 1, every: _Every = None, arrival: _Arrival = False
) -> Answer:
    """Show patterns full screen, next by a key, by a timer or when the photograph arrives; Escape ends it.

    Needs the extra projector.
    """
    if every is not None and arrival:
        raise InputError(f"--every is {every:g}, but --arrival is given; one of them decides what comes next")
    from ltcl.acquisition import rigs

    def progress(shot: Any, done: int, total: int) -> None:
        context.progress(f"photograph {shot.number}: {shot.seconds:g} s, {shot.save_as}", done, total)

    advance = "arrival" if arrival else every or "key"
    count = rigs.show(folder, display=display, advance=advance, progress=progress)
    return Answer({"folder": folder, "shown": count}, lambda: typer.echo(f"{count} pattern(s) were shown"))
