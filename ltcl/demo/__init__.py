# SPDX-License-Identifier: BSD-3-Clause
"""The main result without hardware: a picture in a coloured corner, before and after compensation.

`experiment` computes, `output` fills the folder: first one picture, the sheet of the compensation,
and then all others.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ltcl import checks, errors
from ltcl.demo import experiment, output
from ltcl.files import fill_folder
from ltcl.tasks import report

__all__ = ["STEPS", "Demo", "run"]

FIRST_PICTURE = "first picture"
PICTURES = "pictures"
STEPS = (
    *experiment.COMPENSATION_STEPS,
    FIRST_PICTURE,
    *experiment.STEPS_AFTER_IT,
    PICTURES,
)


@dataclass(frozen=True)
class Demo:
    """Result of `run`: the `folder`, the contents of report.json, and the `files`.

    `files` are all that were written, relative to the folder.
    """

    folder: Path
    report: dict[str, Any]
    files: tuple[str, ...]


def run(
    out: str | os.PathLike[str] = "ltcl-demo",
    size: int = 32,
    *,
    device: Any = None,
    progress: Callable[[str], object] | None = None,
    announce: Callable[[Path], object] | None = None,
) -> Demo:
    """Compute everything and fill the folder `out` with pictures, plots and a report.

    Parameters
    ----------
    out : path
        Folder. compensation.png, the walls before and after compensation, is written first; all
        other files come, and those of an earlier run are replaced, when everything has succeeded.
    size : int
        Patches along a wall, at least 4, of 8 x 8 pixels each: the projector has 192 * size^2
        pixels.
    device : Device or str, optional
        A device as `open_device` takes it.
    progress : callable(step), optional
        Called with each of `STEPS` as it begins.
    announce : callable(path), optional
        Called with the path of compensation.png once it is there.

    Examples
    --------
    >>> import tempfile
    >>> demo = run(tempfile.mkdtemp(), size=4)
    >>> demo.report["errors"]["compensated"] < 0.02 < demo.report["errors"]["uncompensated"]
    True
    """
    checks.count("size", size, least=4)
    for name, value, form in (("progress", progress, "step"), ("announce", announce, "path")):
        if value is not None and not callable(value):
            message = f"{name} is {value!r}; it must be callable({form}), or None"
            raise errors.InputTypeError(message)
    begun: dict[str, float] = {}

    def begin(step: str) -> None:
        begun[step] = time.perf_counter()
        if progress is not None:
            progress(step)

    with fill_folder(out) as folder:
        corner = experiment.compensate_corner(size, device, begin)
        begin(FIRST_PICTURE)
        views = output.write_compensation(corner, folder)
    if announce is not None:
        announce(Path(out) / output.COMPENSATION_SHEET)

    with fill_folder(out) as folder:
        results = experiment.take_apart(corner, begin)
        begin(PICTURES)
        output.write_pictures(results, views, folder)
        text = output.report_of(results, _seconds(begun))
        report.write(folder / "report.json", text)
        files = [file.relative_to(folder) for file in folder.rglob("*") if file.is_file()]
        names = [file.as_posix() for file in files]
    names = sorted([*names, output.COMPENSATION_SHEET])
    return Demo(Path(out), text, tuple(names))


def _seconds(begun: dict[str, float]) -> dict[str, float]:
    """Seconds of each step, the last of which ends now."""
    ends = [*begun.values(), time.perf_counter()][1:]
    seconds = {}
    for (step, start), end in zip(begun.items(), ends, strict=True):
        seconds[step] = round(end - start, 3)
    return seconds
