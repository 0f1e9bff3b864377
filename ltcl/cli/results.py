# SPDX-License-Identifier: BSD-3-Clause
"""The folder that a command fills: its pictures, and a report of its own that lists them.

The report is called after its command, so that several commands may share a folder. The next run of a command
takes away what its last one left and it does not write itself; files of nobody's report stay.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ltcl import report
from ltcl.cli import console
from ltcl.files import fill_folder


@contextmanager
def fill(out: Path, text: dict[str, Any]) -> Iterator[Path]:
    """Fill `out` as `fill_folder` does, and add the report `text` with the list of its files.

    Another run that writes there is refused at once.

    Only when all is in place, the files go that the earlier report of this command listed and this one
    does not.
    """
    from ltcl.batch.manifest import locked

    name = f"{text['command']}.json"
    with locked(out):
        earlier = _listed(out / name)
        with fill_folder(out) as folder:
            yield folder
            found = sorted(
                file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()
            )
            text["files"] = [*found, name]
            report.write(folder / name, text)
        _remove(out, earlier, text["files"])


def _listed(path: Path) -> list[str]:
    """The files that an earlier report lists; none where it is broken or missing."""
    try:
        files = json.loads(path.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    return [file for file in files if isinstance(file, str)] if isinstance(files, list) else []


def _remove(out: Path, earlier: Iterable[str], now: Iterable[str]) -> None:
    # Compared by identity: where a file system ignores case, Sky.png and sky.png are one file.
    keep = {_identity(out / name) for name in now}
    for name in earlier:
        path = _inside(out, name)
        if path is None or _identity(path) in keep:
            continue
        try:
            path.unlink()
        except OSError as error:
            console.note(f"{path}: is of an earlier run and cannot be removed: {error.strerror}")
            continue
        if path.parent != Path(os.path.realpath(out)):
            with suppress(OSError):  # not empty: not only ours
                path.parent.rmdir()


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


def _inside(out: Path, name: str) -> Path | None:
    """The regular file `name` in the folder `out`; None for whatever lies elsewhere or is something else."""
    try:
        root = Path(os.path.realpath(out))
        path = Path(os.path.realpath(root / Path(name).parent)) / Path(name).name
        regular = stat.S_ISREG(path.lstat().st_mode)
    except (OSError, ValueError):
        return None
    strange = Path(name).is_absolute() or ".." in Path(name).parts
    return path if regular and not strange and path.is_relative_to(root) else None
