# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate --transports`: the pictures on each of many scenes, here or on a cluster.

Workers fill a folder of their own and return its files, so that they need no common disk.
"""

from __future__ import annotations

import glob
import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ltcl.batch.cluster import connect
from ltcl.cli.command import Answer, Context
from ltcl.cli.progress import Progress
from ltcl.cli.tables import percent, table
from ltcl.errors import BatchError, InputError, LtclError
from ltcl.files import fill_folder
from ltcl.store.formats import FORMATS

CompensatePictures = Callable[[Context, Path, Sequence[Path], Path], Answer]


def connect_cluster(context: Context) -> AbstractContextManager[Any]:
    """Connect to the cluster of --cluster; None in a block if there is none."""
    cluster = context.options["cluster"]
    workers = context.options["workers"]
    if cluster is not None:
        return connect(cluster, workers, context.options["device"])
    if workers is not None:
        problem = f"--workers is {workers}, but there is no --cluster"
        raise InputError(f"{problem}; it is for --cluster local")
    return nullcontext()


def check_pictures(pictures: list[Path]) -> None:
    """Refuse a transport in place of the first picture."""
    if pictures[0].suffix.lower() in FORMATS:
        problem = f"{pictures[0]}: is a transport, and --transports is given, too"
        raise InputError(f"{problem}; give one of them")


def compensate_scenes(
    context: Context, pictures: list[Path], out: Path, compensate: CompensatePictures
) -> Answer:
    """Compensate the pictures for each transport; those that fail are named at the end."""
    # It imports Dask.
    from ltcl.batch import map as map_scenes

    transports = _find_transports(context.options["transports"], out)
    task = _SceneTask(
        options=_options_of_one_scene(context), pictures=pictures, compensate=compensate
    )
    failure = None
    with connect_cluster(context) as client:
        try:
            results = map_scenes(task, transports, client=client, progress=context.progress)
        except BatchError as error:
            results = error.results
            failure = error
    reports = []
    rows = []
    for transport, files in zip(transports, results, strict=True):
        if isinstance(files, LtclError):
            continue
        folder = out / transport.stem
        _write_files(folder, files)
        report = {"folder": folder, **json.loads(files["compensate.json"])}
        reports.append(report)
        worst = max(picture["error"] for picture in report["pictures"])
        rows.append((transport.stem, report["pictures"][0]["gain"], percent(worst)))
    if failure is not None:
        raise failure
    scenes = table(("scene", "gain", "worst error"), rows)
    lines = [scenes, f"\na folder for each in {out}"]
    return Answer({"folder": out, "scenes": reports}, lines)


def _find_transports(pattern: str, out: Path) -> list[Path]:
    transports = sorted(Path(name) for name in glob.glob(pattern))
    if not transports:
        raise InputError(f"--transports is {pattern}, and there is no such file or folder")
    stems = {transport.stem for transport in transports}
    if len(stems) < len(transports):
        raise InputError(
            f"--transports is {pattern}: it must mean files or folders of different names"
        )
    written = {out.resolve()}
    for stem in stems:
        written.add((out / stem).resolve())
    for transport in transports:
        if transport.resolve() in written:
            raise InputError(f"--out is {out}, where transports are; it must be another place")
    return transports


def _options_of_one_scene(context: Context) -> dict[str, Any]:
    options = {**context.options}
    if options["cluster"] is not None:
        # Each worker has a device of its own.
        options["device"] = None
    return options | dict.fromkeys(("transports", "cluster", "workers"))


@dataclass(frozen=True, kw_only=True)
class _SceneTask:
    """Returns the files for one transport, by their names."""

    options: dict[str, Any]
    pictures: list[Path]
    compensate: CompensatePictures

    def __call__(self, transport: Path) -> dict[str, bytes]:
        with TemporaryDirectory() as temporary, Progress(quiet=True) as progress:
            folder = Path(temporary) / "scene"
            context = Context(name="compensate", options=self.options, progress=progress)
            self.compensate(context, transport, self.pictures, folder)
            return {file.name: file.read_bytes() for file in folder.iterdir()}


def _write_files(place: Path, files: dict[str, bytes]) -> None:
    with fill_folder(place) as folder:
        for name, content in files.items():
            (folder / name).write_bytes(content)
