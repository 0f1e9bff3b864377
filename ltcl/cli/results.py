# SPDX-License-Identifier: BSD-3-Clause
"""The folder that a command fills: its pictures, and a report of its own that lists them.

The report is named after its command, so that several commands may share a folder. A later run of a command
removes what its earlier run listed and it does not write itself; all other files stay.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ltcl import report
from ltcl.files import fill_folder


@contextmanager
def fill(out: Path, text: dict[str, Any]) -> Iterator[Path]:
    """Fill `out` as `fill_folder` does, and write the report `text` with the list of its files.

    A second run that writes there is refused at once.
    """
    from ltcl.batch.manifest import locked

    name = f"{text['command']}.json"
    with locked(out):
        earlier = _listed(out / name)
        with fill_folder(out) as folder:
            yield folder
            files = [file for file in folder.rglob("*") if file.is_file()]
            text["files"] = [*sorted(file.relative_to(folder).as_posix() for file in files), name]
            report.write(folder / name, text)
        now = {file.lower() for file in text["files"]}  # some file systems ignore case
        for file in earlier:
            if file.lower() not in now:
                _remove(out, file)


def _listed(path: Path) -> list[str]:
    """The files that an earlier report lists; none where it is damaged or missing."""
    try:
        return [str(file) for file in json.loads(path.read_text(encoding="utf-8"))["files"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []


def _remove(out: Path, name: str) -> None:
    """Remove a plain file that lies in the folder itself, links resolved, and its folder if that is empty."""
    with suppress(OSError, ValueError):
        folder = (out / name).parent.resolve()
        path = folder / Path(name).name
        if folder.is_relative_to(out.resolve()) and path.is_file() and not path.is_symlink():
            path.unlink()
            if folder != out.resolve():
                folder.rmdir()
