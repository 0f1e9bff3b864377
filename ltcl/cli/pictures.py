# SPDX-License-Identifier: BSD-3-Clause
"""Pictures from files on the grid of a camera or projector, and a folder of results."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.cli.command import Context
from ltcl.errors import InputError
from ltcl.files import fill_folder, locked
from ltcl.tasks import report


@contextmanager
def fill(out: Path) -> Iterator[Path]:
    """Fill a folder whole or not at all; one run at a time."""
    with locked(out, wait=False), fill_folder(out) as folder:
        yield folder


def write_report(folder: Path, text: Any) -> None:
    """Write a report, named after its command, without its `folder`; set its `files` before."""
    name = f"{text.command}.json"
    files = []
    for file in folder.rglob("*"):
        if file.is_file():
            files.append(file.relative_to(folder).as_posix())
    text.files = [*sorted(files), name]
    document = text.document()
    del document["folder"]
    report.write(folder / name, document)


def read(
    context: Context,
    path: Path,
    grid: tuple[int, int],
    owner: str,
    setup: Any = None,
    upright: bool = True,
) -> np.ndarray:
    """Read a linear picture on a `grid`, float32 (h, w[, 3]), by --encoding and --resize.

    Integers are codes for the pixels of the projector of `setup`, if there is one and no other
    encoding is requested. Photographs, not `upright`, keep the camera's pixels. InputError, which
    names the `owner` of the grid, if the size is another.
    """
    from ltcl import images

    encoding = context.options["encoding"]
    projector = None
    if setup is not None and encoding == "auto" and _has_integers(path):
        projector = setup
        encoding = "linear"
        grid = setup.pixels
    picture = images.read(path, encoding=encoding, upright=upright)
    how = context.options["resize"]
    if how is not None:
        picture = images.resize(picture, grid, how)
    elif picture.shape[:2] != grid:
        size = "{} x {}".format(*picture.shape[:2])
        needed = "{} x {}".format(*grid)
        advice = "--resize crop, letterbox or stretch scales it"
        raise InputError(f"{path}: has {size} pixels, but {owner} has {needed}; {advice}")
    return picture if projector is None else projector.light(picture)


def _has_integers(path: Path) -> bool:
    from ltcl import images

    return images.read_codes(path).dtype.kind == "u"


def read_all(
    context: Context,
    paths: Sequence[Path],
    grid: tuple[int, int],
    owner: str,
    setup: Any = None,
    upright: bool = True,
) -> dict[str, np.ndarray]:
    """Read all pictures, by names for their results: stems, longer if an earlier picture has it."""
    pictures: dict[str, np.ndarray] = {}
    # Some file systems ignore case.
    names_in_use: set[str] = set()
    for path in paths:
        name = path.stem
        while name.lower() in names_in_use:
            name += "_2"
        names_in_use.add(name.lower())
        pictures[name] = read(context, path, grid, owner, setup, upright)
    return pictures
