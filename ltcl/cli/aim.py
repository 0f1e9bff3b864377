# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire aim`: brightness, focus and coverage before a scan, in the browser."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import file_option, option
from ltcl.cli.reports.acquisition import AimReport
from ltcl.cli.streams import print_line
from ltcl.cli.view import address, address_options
from ltcl.errors import InputError, LtclError

# Seconds between two looks for a new photograph.
LOOK_PERIOD = 0.5


@command(address_options)
def aim(
    context: Context,
    folder: options.Acquisition,
    photographs: Annotated[
        Path | None,
        file_option(
            "Folder whose newest photograph, of a white projector, is looked at, with a folder "
            "rig. Default: DIR/photographs.",
            metavar="FOLDER",
        ),
    ] = None,
    projector: options.ProjectorName = None,
    looks: Annotated[
        int | None,
        option("End after so many looks. Default: with Ctrl-C.", metavar="N", min=1),
    ] = None,
) -> Answer:
    """Show brightness, focus and coverage of the lit area, in the browser, before a scan.

    A live rig is asked for white, black and fine stripes, again and again, and the exposure follows
    the brightness. With a folder rig project white and take photographs: the newest one is shown.
    Nothing is stored. Ctrl-C ends it.
    """
    from ltcl.acquisition import Project
    from ltcl.viewer.aim import AimScene
    from ltcl.viewer.server import Viewer

    project = Project.open(folder, projector)
    if photographs is not None and project.kind != "folder":
        rig = f"the rig of {project.folder} is {project.kind}"
        raise InputError(f"--photographs is given, but {rig}, not folder")
    place = project.rig_folder / "photographs" if photographs is None else photographs
    scene = AimScene(folder.name)
    report = AimReport(folder=folder)
    count = 0
    with Viewer(scene, **address(context)) as viewer, contextlib.suppress(KeyboardInterrupt):
        print_line(f"{viewer.url} shows what the camera sees; Ctrl-C ends it")
        for name, reading in _readings(project, place, scene):
            count += 1
            scene.add_reading(name, reading)
            details = ", ".join(reading.facts)
            context.progress("looks", count, looks, detail=f": {details}")
            report = AimReport(
                folder=folder,
                looks=count,
                seconds=reading.seconds,
                brightness=reading.brightness,
                saturated=reading.saturated,
                lit=reading.lit,
                focus=reading.focus,
                sharpness=reading.sharpness,
                advice=reading.advice,
            )
            if count == looks:
                lines = [", ".join(reading.facts), *reading.advice]
                return Answer(report, lines)
    return Answer(report, [*report.advice])


def _readings(project: Any, place: Path, scene: Any) -> Iterator[tuple[str, Any]]:
    """Yield the readings of a rig, or of the newest photograph whenever there is a newer one."""
    if project.kind == "folder":
        yield from _newest_photographs(place, scene)
        return
    from ltcl.acquisition.aiming import Aim

    with project.rig(own_pixels=True) as rig:
        aim_rig = Aim(rig)
        for number in itertools.count(1):
            yield f"look {number}", aim_rig.look()


def _newest_photographs(place: Path, scene: Any) -> Iterator[tuple[str, Any]]:
    from ltcl.acquisition.aiming import read_white
    from ltcl.acquisition.captures.order import list_photographs
    from ltcl.acquisition.rigs.photographs import read_photograph
    from ltcl.images.encoding import to_linear

    seen: tuple[str, float] | None = None
    while True:
        newest = None
        with contextlib.suppress(LtclError, OSError):
            dated = [(path.stat().st_mtime, path) for path in list_photographs(place)]
            newest = max(dated, default=None)
        if newest is not None and (newest[1].name, newest[0]) != seen:
            seen = newest[1].name, newest[0]
            try:
                codes = read_photograph(newest[1].name, newest[1], 3, None)
            except LtclError as error:
                # It may still be on its way.
                scene.add_warning(" ".join(str(error).split()))
            else:
                # Codes as they are, as brightness is a matter of full scale.
                yield newest[1].name, read_white(to_linear(codes, "linear"))
        else:
            time.sleep(LOOK_PERIOD)
