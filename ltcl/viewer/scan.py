# SPDX-License-Identifier: BSD-3-Clause
"""`Scan`: the folder of an acquisition as it grows, and its transport once that is finished.

What is new is read when a page asks, the newest first, for a while only. A rig that a person works
by hand has all photographs in the folder. Of others those of the calibration are there until it has
ended; then come batches of the scan, columns of T or pictures of an adaptive scan, in units of
light.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks, images
from ltcl.acquisition import Calibration, Project, Setup
from ltcl.acquisition.agreement import find_deviation, sample
from ltcl.acquisition.calibrate import expected_photographs
from ltcl.acquisition.rig import to_unit
from ltcl.acquisition.rigs.photographs import read_photograph
from ltcl.acquisition.rigs.shooting_list import Shot
from ltcl.acquisition.session import calibration_folder
from ltcl.errors import LtclError
from ltcl.store import ArrayLog, BlockStore, load
from ltcl.viewer.answers import Reply, Scene

_BUDGET, _PERIOD = 0.5, 0.9  # seconds of reading in a look, and from one to the next
_SIDE, _BINS, _SHOWN = (
    160,
    32,
    24,
)  # pixels of a preview; of a histogram; photographs that a page has
_PACE = 32  # of the newest files: by them the time that is left is estimated
_FULL, _SATURATED = 0.999, 0.02  # of full scale; part of a photograph


class _File(NamedTuple):
    """Of a photograph, or of batch `number` of a scan; `shot` of those taken by hand."""

    path: Path
    time: float
    number: int = 0
    shot: Shot | None = None


class Scan(Scene):
    """A folder with an acquisition.toml; `T` is None, and only `scan` may be asked, until it is finished."""

    questions = ("scan", "pictures")

    def __init__(self, folder: Path, device: Any) -> None:
        super().__init__(None, folder.name, {}, None)
        self.project, self._device = Project.open(folder), device
        self._looked = 0.0
        self._read: dict[Path, float] = {}  # when files that were read had been written
        self._shown: dict[str, tuple[int, dict[str, Any], np.ndarray]] = {}  # photographs in order
        self._count = 0  # of those that were ever shown
        self._warnings: dict[str, str] = {}
        self._facts: dict[str, Any] = {}
        self._kind: Any = None  # shape and type of the first photograph
        self._samples: defaultdict[str, dict[int, tuple[float, np.ndarray]]] = defaultdict(dict)
        self._calibration: Calibration | None = None
        self._total = 0
        if self.project.state == "final":
            self._finish()
        else:
            settings, facts = self.project.outlook()
            ways = {
                "aligned": settings.geometry == "aligned",
                "by_hand": self.project.kind == "folder",
            }
            self._total = expected_photographs(
                facts["grid"], facts["channels"], settings.frames, **ways
            )
            self.pixels = int(np.prod(facts["grid"]))

    def scan(self, seen: Any) -> Reply:
        """How far it is and what is wrong, and photographs of which a page has `seen` so many."""
        checks.count("seen", seen, least=0)
        if time.monotonic() > self._looked + _PERIOD:
            try:
                self._look()
            except (LtclError, OSError) as error:  # files that change just now
                self._warnings["folder"] = " ".join(str(error).split())
            self._looked = time.monotonic()
        new = [(f, preview) for number, f, preview in self._shown.values() if number > seen]
        facts = self._facts | {
            "warnings": [*self._warnings.values()],
            "photographs": [f for f, _ in new],
        }
        facts |= {"seen": self._count, "finished": self.T is not None}
        return facts, {str(k): preview for k, (_, preview) in enumerate(new)}

    def _look(self) -> None:
        self._warnings.pop("folder", None)
        state, store, kind = self.project.state, None, self.project.kind
        if state != "new":
            store = BlockStore.open(self.project.store)
            self._calibration = self._calibration or Calibration.of(store)
        files = list(self._by_hand() if kind == "folder" else self._in_store(store))
        done, total, what = len(files), self._total, "photographs of the calibration"
        if store and kind == "folder":
            total, what = int(store.attributes["plan"]["photographs"]), "photographs"
        elif store:
            batches, total = (
                store.layout.blocks("columns"),
                int(store.attributes["plan"]["patterns"]),
            )
            done, what = round(total * done / batches), "patterns"
        if store and store.final:
            done = total = int(store.attributes["patterns"])
        total, newest = max(total, done), sorted(files, key=lambda file: -file.time)
        times = [file.time for file in newest[:_PACE]]
        self._facts = {"state": state, "done": done, "total": total, "what": what, "left": None}
        if total > done and len(times) > 1:  # each file has as many on average
            each = (times[0] - times[-1]) / (len(times) - 1) * len(files) / done
            self._facts["left"] = each * (total - done)
        if c := self._calibration:
            self._facts["coverage"] = float(np.mean(c.resampling.coverage > 0))
            self._facts["saturated"] = 1.0 - float(np.mean(c.white.valid))
        end = time.monotonic() + _BUDGET
        for file in [
            *newest[-1:],
            *newest[:-1],
        ]:  # the first photograph says what the others have to be
            if self._read.get(file.path) != file.time and time.monotonic() < end:
                self._read[file.path] = file.time
                self._open(file, store)
        if state == "final" and self.T is None:
            self._finish()

    def _by_hand(self) -> Iterator[_File]:
        """Photographs by their numbers."""
        with self.project.rig() as self._camera:
            self._camera.missing()  # which looks for them
            for shot in self._camera.shots:
                if file := self._camera.file_name(shot.number):
                    path = self._camera.folder / "photographs" / file
                    yield _File(path, path.stat().st_mtime, shot.number, shot)

    def _in_store(self, store: BlockStore | None) -> Iterator[_File]:
        """Photographs of the calibration in the order in which they were taken, or batches of the scan."""
        place = calibration_folder(self.project.store) if store is None else store.path / "log"
        paths = place.glob("shot_*.npz" if store is None else "columns_0.*.npz")
        times = sorted((path.stat().st_mtime, path) for path in paths)
        for number, (written, path) in enumerate(times, 1):
            yield _File(path, written, number if store is None else int(path.stem[10:]))

    def _open(self, file: _File, store: BlockStore | None) -> None:
        """Read a photograph or a batch: its preview, its histogram and what is wrong with it."""
        name, facts = f"photograph {file.number}", dict[str, Any]()
        self._warnings.pop(name, None)
        if file.shot is None and store is not None:
            light = store.block(0, file.number).matrix.sum(axis=0)
            light = np.reshape(light, store.layout.camera_grid or store.layout.grid)
            codes = images.to_srgb(light / max(light.max(), 1e-30))
            name = f"batch {file.number + 1}"
        else:
            try:
                codes = self._codes(name, file)
            except LtclError as error:
                self._warnings[name] = " ".join(str(error).split())
                return
            counts, _ = np.histogram(codes[:: 1 + codes.shape[0] // 1000], _BINS, (0.0, 1.0))
            facts = {"histogram": counts / counts.sum(), "seconds": file.shot and file.shot.seconds}
            if file.shot is not None:
                self._check(name, file.shot, codes)
        step = -(-max(codes.shape[:2]) // _SIDE)
        preview = np.rint(255 * codes[::step, ::step].clip(0, 1)).astype(np.uint8)
        self._count += 1
        self._shown[name] = self._count, {"name": name, "time": file.time, **facts}, preview
        if len(self._shown) > _SHOWN:
            del self._shown[min(self._shown, key=lambda name: self._shown[name][1]["time"])]

    def _codes(self, name: str, file: _File) -> np.ndarray:
        """A photograph in [0, 1] of full scale; AcquisitionError, as `acquire` raises it."""
        if file.shot is None:
            image = ArrayLog(file.path.parent).get(file.path.stem)["image"]
            bits = self.project.table.get("bits")
            camera: Any = SimpleNamespace(channels=1 if image.ndim == 2 else 3, bits=bits)
        else:
            camera = self._camera
            image = read_photograph(name, file.path, camera.channels, file.shot.seconds)
        codes = to_unit(name, image, camera, self._kind)
        self._kind = image.shape, image.dtype
        return codes

    def _check(self, name: str, shot: Shot, codes: np.ndarray) -> None:
        """Compare a photograph with the others of its pattern, once the camera is known."""
        self._samples[shot.pattern][shot.number] = shot.seconds, sample(codes)
        if (c := self._calibration) is None:
            return
        saturated = float(np.mean(codes >= _FULL))
        if saturated > _SATURATED and shot.seconds <= c.exposures[0]:
            self._warnings[name] = f"{name}: {saturated:.0%} are saturated in the shortest exposure"
        numbers, taken = zip(*sorted(self._samples[shot.pattern].items()), strict=True)
        seconds, samples = zip(*taken, strict=True)
        self._warnings.pop(shot.pattern, None)
        if len({*seconds}) > 1 and (found := find_deviation(samples, seconds, c.camera)):
            self._warnings[shot.pattern] = found.describe(numbers)

    def _finish(self) -> None:
        """The transport is there: all that a Scene has, in one assignment, as pages ask meanwhile."""
        T, setup = (
            load(self.project.store, on_dark="mask", device=self._device),
            Setup.of(self.project.store),
        )
        questions = (*Scene.questions, "scan")
        self.__dict__ = (
            vars(self) | vars(Scene(T, self.title, {}, setup)) | {"questions": questions}
        )
