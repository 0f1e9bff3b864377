# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire run` and `resume`: photographs are taken, or asked for, until the transport is there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltcl.cli import acquire_report, console, options
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing, ScanRefused

if TYPE_CHECKING:
    from ltcl.acquisition import Project

_FEW = 8  # runs of numbers
_SETTLING = 1.0  # seconds in which batches of earlier runs are told
_Take = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="With the camera's own files, as many as photographs are missing: they are copied there, in the "
        "order of the numbers in their names. For folder rigs.",
        show_default=False,
    ),
]


def run(folder: options.Acquisition, device: options.Device = None, json: options.Json = False) -> None:
    """Measure the set-up, then photograph all patterns; the transport comes to DIR/transport.zarr.

    A folder rig writes patterns and a shooting list, and ends where photographs are missing: take them, then
    'ltcl acquire resume'. After Ctrl-C, too, and whatever else ends it early.
    """
    from ltcl.acquisition import Project, kept

    project = Project.open(folder)
    if project.state == "begun":
        raise InputError(f"{project.store}: is begun; {project.next} goes on")
    if project.state == "new" and kept.busy(project.store):
        raise FileError(f"{kept.place(project.store)}: another process is at work there; one must end first")
    if project.state == "new" and project.kept:
        raise InputError(
            f"{kept.place(project.store)}: holds {project.kept} photographs of a calibration that has not "
            f"ended; {project.next} goes on, and to begin anew it must be removed"
        )
    if project.state == "final":
        raise InputError(
            f"{project.store}: is finished; 'ltcl acquire report {folder}' tells what came of it, and to "
            "begin anew it must be removed"
        )
    _go(project, device, json)


def resume(
    folder: options.Acquisition,
    take: _Take = None,
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Go on where an acquisition ended; with a folder rig, once photographs have been taken."""
    from ltcl.acquisition import Project

    project = Project.open(folder)
    if take is not None:
        _take(project, take)
    if project.state == "final":
        _finished(project, device, json)
        return
    if project.state == "new" and project.kind != "folder" and not project.kept:
        console.note(f"{project.store}: is not begun yet, so this begins with the calibration")
    _go(project, device, json)


def _finished(project: Project, device: str | None, json: bool) -> None:
    """Nothing is left to do, unless the file now asks for something else."""
    opened = open_device(device)
    from ltcl.acquisition import acquire

    with project.described() as rig, project.naming("acquire"):
        acquire(rig, store=project.store, device=opened, **project.settings)
    console.note(f"{project.store}: is finished already")
    acquire_report.tell(project, opened, json)


def _go(project: Project, device: str | None, json: bool) -> None:
    opened = open_device(device)  # before the photographs, not after them
    from ltcl.acquisition import acquire

    progress = console.Frames("patterns", _SETTLING)
    heard = console.hearing("ltcl.acquisition", progress.at)
    with project.rig() as rig, _ending(project, rig), progress, heard, project.naming("acquire"):
        acquire(rig, store=project.store, progress=progress, device=opened, **project.settings)
    acquire_report.tell(project, opened, json)


@contextmanager
def _ending(project: Project, rig: Any) -> Iterator[None]:
    """What ends an acquisition early is told with the way to go on."""
    try:
        yield
    except PhotographMissing as error:
        raise _asking(project, rig, error) from None
    except ScanRefused as error:
        anew = f"once {project.store} is removed, 'ltcl acquire run {project.folder}' begins anew"
        raise ScanRefused(f"{error}; {anew}") from error
    except AcquisitionError as error:
        raise AcquisitionError(f"{error}; {_left(project)}") from error
    except KeyboardInterrupt:
        console.note(_left(project))
        raise


def _left(project: Project) -> str:
    """What an acquisition that ended early has left, and how to go on."""
    from ltcl.acquisition import kept

    if project.state == "begun":
        return f"what was photographed before is kept in {project.store}, {project.next} goes on"
    if project.kept:
        place = kept.place(project.store)
        return f"{project.kept} photographs of the calibration are kept in {place}, {project.next} goes on"
    if project.kind == "folder":
        return (
            f"photographs that are wrong must be taken anew in {project.folder}/photographs, then 'ltcl "
            f"acquire resume {project.folder}' goes on"
        )
    return f"nothing of the calibration is kept, {project.next} begins it anew"


def _asking(project: Project, rig: Any, error: PhotographMissing) -> PhotographMissing:
    """What a person has to do now, in one line."""
    missing, folder = rig.missing(), project.folder
    strange = str(error).partition("; ")[2]  # the name of no photograph
    text = (
        f"{len(missing)} photograph(s) are missing: {_ranges(missing)}; {folder}/shots.csv lists which "
        f"pattern of {folder}/patterns to show, for how long to expose, and the name to save it by in "
        f"{folder}/photographs; then: ltcl acquire resume {folder}"
    )
    return PhotographMissing(f"{text} ({strange})" if strange else text, error.number)


def _ranges(numbers: tuple[int, ...]) -> str:
    """Numbers, those that follow each other together.

    >>> _ranges((1, 2, 3, 7, 9, 10)), _ranges(tuple(range(1, 40, 2)))
    ('1 to 3, 7, 9 to 10', '1, 3, 5, 7, 9, 11, ... 39')
    """
    starts = [n for n in numbers if n - 1 not in numbers]
    ends = [n for n in numbers if n + 1 not in numbers]
    found = [str(a) if a == b else f"{a} to {b}" for a, b in zip(starts, ends, strict=True)]
    return ", ".join(found if len(found) <= _FEW else [*found[: _FEW - 2], f"... {found[-1]}"])


def _take(project: Project, source: Path) -> None:
    if project.kind != "folder":
        raise InputError(
            f"--take is given, but the rig of {project.folder} is {project.kind}; it is for a folder rig"
        )
    if not source.is_dir():
        raise FileError(f"{source}: is no folder; --take needs the one with the camera's files")
    files = [path for path in source.iterdir() if path.is_file() and not path.name.startswith(".")]
    with project.rig() as rig:
        missing = len(rig.missing())
        if len(files) != missing:
            raise InputError(f"{source}: holds {len(files)} files, but {missing} photographs are missing")
        rig.take(files)
