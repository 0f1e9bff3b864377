# SPDX-License-Identifier: BSD-3-Clause
"""The scans of several projectors one by one, as steps that are done or not: `pending_steps`.

For each projector, while the others are black:

    check    did the camera move since the first projector was mapped? Not for the first
    map      which projector pixel each camera pixel sees
    scan     T on the pixels that all projectors share

and a last check in the end. What is done stands in files of the folder, so that the steps go on
where they were. The response of the camera is measured with the first projector and known for the
others, so that all T have one unit of light.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.project import Project
from ltcl.acquisition.projectors import CameraMoved, check_camera, measure_view
from ltcl.acquisition.projectors.combined import write_facts
from ltcl.acquisition.projectors.movement import MAX_MOVEMENT
from ltcl.acquisition.projectors.view import photograph_blocks
from ltcl.acquisition.task import acquire
from ltcl.errors import FileError
from ltcl.files import replace_file

# Folder of the photographs of checks by hand, and the name of the last check.
CHECKS = "checks"
END = "end"

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step of the scans.

    Attributes
    ----------
    project : Project
        Whose projector shows patterns; the others are black.
    what : str
        "map", "scan", or "check".
    folder : Path
        That of patterns and photographs with a folder rig.
    before : str
        Of a check: the name of the projector that is scanned next, or "end".
    """

    project: Project
    what: str
    folder: Path
    before: str = ""

    @contextlib.contextmanager
    def rig(self) -> Iterator[Any]:
        """The rig of the step, which is closed at the end of the block."""
        is_scan = self.what == "scan"
        with self.project.rig(own_pixels=not is_scan, photographs=self.folder) as rig:
            yield rig

    @property
    def result(self) -> Path:
        """The file or store that the step makes."""
        if self.what == "map":
            return self.project.view_path
        if self.what == "check":
            return self.project.folder / f"{self.before}.check.json"
        return self.project.store

    @property
    def is_done(self) -> bool:
        """True if the result is there, whole."""
        if self.what == "scan":
            return self.project.state == "final"
        return self.result.exists()

    def run(self, rig: Any, first: Project, progress: Progress, device: Any) -> None:
        """Take the step; `first` is the first projector. Errors are those of `ltcl.acquire`."""
        name = self.project.name

        def named(step: str, done: int, total: int) -> None:
            progress(f"{name}: {step}", done, total)

        if self.what == "map":
            with self.project.naming("rig"):
                measure_view(rig, self.result, named)
        elif self.what == "check":
            self._check(rig)
        else:
            self._scan(rig, first, named, device)

    def _check(self, rig: Any) -> None:
        """Compare the blocks of the first projector with those of its map."""
        view = self.project.view()
        if view is None:
            raise FileError(f"{self.project.view_path}: no such file; it was there before")
        image = photograph_blocks(rig, view.seconds)
        when = f"before the scan of {self.before}"
        if self.before == END:
            when = "before the end of the last scan"
        movement = check_camera(view.blocks, image, when)
        facts = {"movement": round(movement, 4), "largest": MAX_MOVEMENT}
        with replace_file(self.result) as temporary:
            temporary.write_text(json.dumps(facts) + "\n", encoding="utf-8")

    def _scan(self, rig: Any, first: Project, progress: Progress, device: Any) -> None:
        view = self.project.view()
        if view is None:
            raise FileError(f"{self.project.view_path}: no such file; it was there before")
        camera_grid = view.mapping.camera_grid
        settings = self.project.scan_settings(camera_grid)
        if self.project != first and settings.get("response") is None:
            settings["response"] = Calibration.of(first.store).response
        keep_facts(self.project, self.result)
        with self.project.naming("acquire"):
            acquire(rig, store=self.result, progress=progress, device=device, **settings)


def keep_facts(project: Project, store: Path) -> None:
    """Keep beside a store how its pixels belong to those of the projector of a project."""
    view = project.view()
    if view is None:
        raise FileError(f"{project.view_path}: no such file; it was there before")
    side = project.scan_side(view.mapping.camera_grid)
    write_facts(store, view=project.view_path, side=side)


def scanned_stores(folder: Path) -> list[Path]:
    """The stores of a folder with several projectors, which must be finished.

    FileError names one that is not.
    """
    stores = []
    for project in Project.open_all(folder):
        if not project.store.exists():
            raise FileError(f"{project.store}: no such folder yet; 'ltcl acquire run' makes it")
        if project.state != "final":
            raise FileError(
                f"{project.store}: is still being scanned; 'ltcl acquire run' goes on with it"
            )
        stores.append(project.store)
    return stores


def pending_steps(projects: Sequence[Project]) -> Iterator[Step]:
    """The steps that are not done, in order; each is to be taken before the next one."""
    first = projects[0]
    for project in projects:
        checks = first.folder / CHECKS / project.name
        steps = [
            Step(project=project, what="map", folder=project.rig_folder),
            Step(project=project, what="scan", folder=project.rig_folder),
        ]
        if project != first:
            steps.insert(0, Step(project=first, what="check", folder=checks, before=project.name))
        if steps[-1].is_done:
            continue
        for step in steps:
            if not step.is_done:
                yield step
    last = Step(project=first, what="check", folder=first.folder / CHECKS / END, before=END)
    if not last.is_done:
        yield last


def movements(projects: Sequence[Project]) -> dict[str, float]:
    """Movement of the camera in pixels that each check has found, by what came after it."""
    moved = {}
    for name in [*[project.name for project in projects[1:]], END]:
        path = projects[0].folder / f"{name}.check.json"
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            moved[name] = float(json.loads(path.read_text(encoding="utf-8"))["movement"])
    return moved


__all__ = [
    "CameraMoved",
    "Step",
    "keep_facts",
    "movements",
    "pending_steps",
    "scanned_stores",
]
