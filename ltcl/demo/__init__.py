# SPDX-License-Identifier: BSD-3-Clause
"""The main result without hardware: a picture thrown into a coloured corner, before and after compensation.

`experiment` computes, `target` makes the picture that is wanted, `output` fills the folder.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ltcl import checks, report
from ltcl.demo import experiment, output
from ltcl.files import fill_folder

__all__ = ["STEPS", "Demo", "run"]

STEPS = (*experiment.STEPS, "pictures")


@dataclass(frozen=True)
class Demo:
    """Result of `run`.

    Attributes
    ----------
    folder : Path
    report : dict
        The contents of report.json.
    files : tuple of str
        All files written, relative to `folder`.
    """

    folder: Path
    report: dict[str, Any]
    files: tuple[str, ...]


def run(
    out: str | os.PathLike[str] = "ltcl-demo",
    size: int = 36,
    *,
    device: Any = None,
    progress: Callable[[str], object] | None = None,
) -> Demo:
    """Compute everything and fill the folder `out` with pictures, plots and a report.

    Parameters
    ----------
    out : path
        Folder; files of an earlier run are replaced only when everything has succeeded.
    size : int
        Patches along a wall, at least 4: the projector has 3 * size^2 pixels.
    device : Device or str, optional
        As `open_device` takes it.
    progress : callable, optional
        Called with each of `STEPS` as it begins.

    Returns
    -------
    Demo

    Raises
    ------
    InputError
        A size below 4.
    MemoryLimitError
        A size whose matrices do not fit.
    DeviceError
        No OpenCL device.
    FileError
        The folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> demo = run(tempfile.mkdtemp(), size=4)
    >>> demo.report["errors"]["compensated"] < 0.02 < demo.report["errors"]["uncompensated"]
    True
    """
    checks.count("size", size, least=4)
    clock = _Clock(progress)
    with fill_folder(out) as folder:
        found = experiment.compute(size, device, clock.start)
        clock.start("pictures")
        output.write_pictures(found, folder)
        clock.stop()
        text = output.report_of(found, clock.seconds)
        report.write(folder / "report.json", text)
        files = sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file())
    return Demo(Path(out), text, tuple(files))


@dataclass
class _Clock:
    """Tells which step begins, and how long each took."""

    progress: Callable[[str], object] | None
    seconds: dict[str, float] = field(default_factory=dict)
    _running: tuple[str, float] | None = None

    def start(self, step: str) -> None:
        self.stop()
        self._running = (step, time.perf_counter())
        if self.progress is not None:
            self.progress(step)

    def stop(self) -> None:
        if self._running is not None:
            step, since = self._running
            self.seconds[step] = round(time.perf_counter() - since, 3)
        self._running = None
