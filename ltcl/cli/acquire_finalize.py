# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire finalize`: the transport of what has been photographed, without the rig that did it."""

from __future__ import annotations

import typer

from ltcl.cli import console, options
from ltcl.errors import AcquisitionError, FileError


def run(folder: options.Acquisition, json: options.Json = False) -> None:
    """Make the transport of what has been photographed; needs neither the rig nor a device.

    Where photographs are missing, says how many batches of patterns.
    """
    from ltcl.acquisition import Project, finalize

    project = Project.open(folder)
    if project.state == "new":
        raise FileError(f"{project.store}: is not begun; {project.next} photographs it")
    done = project.state == "final"
    try:
        with console.Frames("patterns") as progress:
            finalize(project.store, progress)
    except AcquisitionError as error:
        raise AcquisitionError(f"{error}; {project.next} goes on") from None
    if json:
        console.answer({"folder": folder, "store": project.store, "before": done})
    else:
        typer.echo(f"{project.store}: is {'finished already' if done else 'finished'}")
