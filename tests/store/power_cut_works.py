# SPDX-License-Identifier: BSD-3-Clause
"""What writes files, recorded for `power_cuts`: `save`, an acquisition, patterns for frames."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import scipy.sparse

import ltcl
from ltcl.batch import film_run
from ltcl.errors import LtclError
from ltcl.store import ArrayLog, BlockStore, formats
from tests.acquisition.stopping import set_up
from tests.store.power_cuts import Judge, Operation, Recorder
from tests.store.stores import contents

GRID = (3, 4)
FRAMES = 6


@dataclass(frozen=True, kw_only=True)
class Work:
    """Operations of a program, and how to read and to judge a folder that it leaves."""

    operations: list[Operation]
    read: Callable[[Path], Hashable]
    judge: Judge
    resume: Callable[[Path], object] | None = None


def transport(scale: float, *, is_sparse: bool) -> ltcl.Transport:
    """T of 12 pixels."""
    values = scale * (np.eye(12) / 2 + np.full((12, 12), 0.01))
    if is_sparse:
        values = np.diag(np.diag(values))
        return ltcl.Transport(scipy.sparse.csr_array(values), GRID)
    return ltcl.Transport(values, GRID)


def saving(name: str, *, replaces: bool, is_sparse: bool = False) -> Work:
    """`ltcl.save` at a path, over an earlier file or into new folders."""
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        path = root / name
        if replaces:
            ltcl.save(path, transport(1.0, is_sparse=is_sparse))
        recorder = Recorder(root)
        with recorder.recording():
            ltcl.save(path, transport(2.0, is_sparse=is_sparse))
            recorder.commit("saved")

    def read(folder: Path) -> Hashable:
        if not (folder / name).exists() and not replaces:
            return "absent"
        try:
            record: Any = formats.read(folder / name)
            (matrix,) = record.in_memory().matrices
        except LtclError as error:
            return f"refused: {error}"
        T = matrix.toarray() if is_sparse or hasattr(matrix, "toarray") else matrix
        for scale in (1.0, 2.0):
            if np.allclose(T, transport(scale, is_sparse=is_sparse).to_numpy()):
                return scale
        return "other values"

    def judge(outcome: Any, committed: frozenset[Hashable]) -> str:
        before = 1.0 if replaces else "absent"
        if outcome == 2.0 or (outcome == before and not committed):
            return ""
        return "wrong" if outcome == "other values" else "lost"

    def resume(folder: Path) -> None:
        ltcl.save(folder / name, transport(2.0, is_sparse=is_sparse))
        assert read(folder) == 2.0
        assert [file.name for file in (folder / name).parent.iterdir()] == [Path(name).name]

    return Work(operations=recorder.operations, read=read, judge=judge, resume=resume)


def acquisition(strategy: str = "pixel") -> Work:
    """`ltcl.acquire`, its calibration included; entries of its logs are committed one by one."""
    put = ArrayLog.put
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        path = root / "T.zarr"
        recorder = Recorder(root)

        def put_and_commit(log: ArrayLog, name: str, **arrays: Any) -> None:
            put(log, name, **arrays)
            recorder.commit((log.path.name, name))

        rig, settings = set_up(strategy)
        with mock.patch.object(ArrayLog, "put", put_and_commit), recorder.recording():
            ltcl.acquire(rig, store=path, **settings)
            recorder.commit("final")
        expected = contents(path)

    def read(folder: Path) -> Hashable:
        path = folder / "T.zarr"
        shots = ArrayLog(folder / "T.zarr.calibration")
        try:
            if not path.exists():
                return "calibration", _readable(shots)
            store = BlockStore.open(path)
            store.verify()
            if store.final:
                files = contents(path)
                is_right = all(files[name] == expected[name] for name in expected)
                return "final" if is_right else "other values"
            if "strategy" not in store.attributes:
                return "calibration", _readable(shots)
            return "log", _readable(ArrayLog(path / "log"))
        except LtclError as error:
            return f"refused: {error}"

    def judge(outcome: Any, committed: frozenset[Hashable]) -> str:
        if outcome == "final":
            return ""
        if isinstance(outcome, str):
            return "wrong" if outcome == "other values" else "lost"
        stage, names = outcome
        needed = {what for what in committed if isinstance(what, tuple)}
        if stage == "calibration":
            needed = {what for what in needed if what[0] == "T.zarr.calibration"}
        else:
            needed = {what for what in needed if what[0] == "log"}
        is_lost = "final" in committed or not {name for _, name in needed} <= names
        return "lost" if is_lost else ""

    def resume(folder: Path) -> None:
        rig, settings = set_up(strategy)
        ltcl.acquire(rig, store=folder / "T.zarr", **settings)
        assert contents(folder / "T.zarr") == expected
        assert [file.name for file in folder.iterdir()] == ["T.zarr"]

    return Work(operations=recorder.operations, read=read, judge=judge, resume=resume)


def _readable(log: ArrayLog) -> frozenset[str]:
    """Names of the entries of a log, all of which can be read."""
    for name in log.names:
        log.get(name)
    return frozenset(log.names)


def patterns(*, appearance: bool) -> Work:
    """`compensate_frames`; each batch is committed when `progress` tells of it."""
    T = transport(1.0, is_sparse=False)
    random = np.random.default_rng(5)
    pictures = random.uniform(0.1, 0.3, (FRAMES, *GRID)).astype(np.float32)

    def run(folder: Path, progress: Any = None) -> Any:
        return ltcl.batch.compensate_frames(
            T,
            folder / "film",
            folder / "out",
            batch=2,
            resume=True,
            appearance=appearance,
            progress=progress,
        )

    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        (root / "film").mkdir()
        for number, picture in enumerate(pictures):
            ltcl.images.write(root / f"film/{number}.exr", picture)
        recorder = Recorder(root)
        with recorder.recording():
            run(root, progress=lambda step, done, count: recorder.commit(done))
        expected = contents(root / "out")

    def read(folder: Path) -> Hashable:
        listed = folder / "out/frames.json"
        if not listed.exists():
            return 0
        try:
            frames = json.loads(listed.read_text())["frames"]
        except ValueError as error:
            return f"refused: {error}"
        files = contents(folder / "out")
        done = [frame for frame in frames if _is_done(folder / "out", frame, appearance)]
        for frame in done:
            for name in _names(frame, appearance):
                if files[name] != expected[name]:
                    return "other values"
        return len(done)

    def judge(outcome: Any, committed: frozenset[Hashable]) -> str:
        if isinstance(outcome, str):
            return "wrong" if outcome == "other values" else "lost"
        done: Any = max(committed, default=0)  # pyright: ignore[reportArgumentType]
        return "lost" if outcome < done else ""

    def resume(folder: Path) -> None:
        run(folder)
        assert contents(folder / "out") == expected

    return Work(operations=recorder.operations, read=read, judge=judge, resume=resume)


def _names(frame: dict[str, Any], appearance: bool) -> list[str]:
    number = frame["number"]
    names = [f"pattern_{number:06}.png"]
    if appearance:
        names.append(f"appearance/appearance_{number:06}.png")
    return names


def _is_done(folder: Path, frame: dict[str, Any], appearance: bool) -> bool:
    """True if the files of a frame are those that the list tells of."""
    paths = [folder / name for name in _names(frame, appearance)]
    try:
        return film_run.files_digest(paths) == frame["output_digest"]
    except FileNotFoundError:
        return False


def all_works() -> dict[str, Work]:
    """Every work by its name."""
    works = {}
    for extension in (".npz", ".npy", ".mtx", ".h5", ".mat", ".zarr"):
        works[f"save {extension} over another"] = saving(f"T{extension}", replaces=True)
        works[f"save {extension} in new folders"] = saving(f"a/b/T{extension}", replaces=False)
    works["save sparse .npz"] = saving("T.npz", replaces=True, is_sparse=True)
    works["save sparse .h5"] = saving("T.h5", replaces=True, is_sparse=True)
    with mock.patch("ltcl.files.exchange", return_value=False):
        works["save .zarr where no folders are exchanged"] = saving("T.zarr", replaces=True)
    for strategy in ("pixel", "adaptive"):
        works[f"acquire, {strategy}"] = acquisition(strategy)
    works["compensate_frames"] = patterns(appearance=False)
    works["compensate_frames with appearances"] = patterns(appearance=True)
    return works
