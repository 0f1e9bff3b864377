# SPDX-License-Identifier: BSD-3-Clause
"""`Scan`: the folder of an acquisition as it grows, and its transport once that is finished.

New files are read when a page asks, the newest first, for a limited time only.
"""

from __future__ import annotations

import contextlib
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import Calibration, Project, Setup
from ltcl.acquisition.agreement import find_deviation, sample
from ltcl.acquisition.calibrate import expected_photographs
from ltcl.acquisition.radiance import valid_share
from ltcl.acquisition.rigs.shooting_list import Shot
from ltcl.acquisition.scanning.plan import is_sparing
from ltcl.errors import LtclError
from ltcl.store import BlockStore, load
from ltcl.viewer import scan_files
from ltcl.viewer.answers import QUESTIONS, Reply, ViewerScene
from ltcl.viewer.scan_files import PhotographReader, ScanFile

# Seconds of reading in one look at the folder, and from one look to the next.
READING_SECONDS = 0.5
LOOK_PERIOD = 0.9
# Pixels along the longer side of a preview.
PREVIEW_SIDE = 160
HISTOGRAM_BINS = 32
# Rows of a photograph that its histogram counts, about.
HISTOGRAM_ROWS = 1000
# Previews that are kept; the oldest photograph is dropped.
MAX_PREVIEWS = 24
# The newest files, by which the time left is estimated.
PACE_FILES = 32
# Share of full scale from which a pixel is saturated, and share of a photograph that may be.
SATURATION_LEVEL = 0.999
MAX_SATURATED_SHARE = 0.02


@dataclass(frozen=True, kw_only=True)
class Preview:
    """A photograph or batch on a page."""

    # Number of the preview among all that were ever shown.
    number: int
    facts: dict[str, Any]
    picture: np.ndarray


class Scan(ViewerScene):
    """A folder with an acquisition.toml.

    `T` is None, and only `scan` and `pictures` may be asked, until it is finished.
    """

    def __init__(self, folder: Path, device: Any) -> None:
        super().__init__(None, folder.name, {}, None)
        self.project = Project.open(folder)
        self._device = device
        self._looked_at = 0.0
        # When files that have been read had been written.
        self._times_read: dict[Path, float] = {}
        self._previews: dict[str, Preview] = {}
        self._preview_count = 0
        self._warnings: dict[str, str] = {}
        self._progress: dict[str, Any] = {}
        self._reader = PhotographReader(self.project.table.get("bits"))
        self.agreement = PhotographAgreement()
        self._calibration_photographs = 0
        if self.project.state == "final":
            self._show_result()
        else:
            self._expect()

    @property
    def questions(self) -> tuple[str, ...]:
        """Questions that may be asked now."""
        if self.T is None:
            return ("scan", "pictures")
        return (*QUESTIONS, "scan")

    def scan(self, seen: Any) -> Reply:
        """Return progress, warnings, and the previews after the first `seen` ones."""
        checks.count("seen", seen, least=0)
        if time.monotonic() > self._looked_at + LOOK_PERIOD:
            try:
                self._look()
            except (LtclError, OSError) as error:
                # Files may change just now.
                self._warnings["folder"] = _one_line(error)
            self._looked_at = time.monotonic()
        new = [preview for preview in self._previews.values() if preview.number > seen]
        facts = {
            **self._progress,
            "warnings": [*self._warnings.values()],
            "photographs": [preview.facts for preview in new],
            "seen": self._preview_count,
            "finished": self.T is not None,
        }
        pictures = {str(k): preview.picture for k, preview in enumerate(new)}
        return facts, pictures

    def _expect(self) -> None:
        """Find out how many photographs the calibration takes."""
        settings, facts = self.project.outlook()
        self._calibration_photographs = expected_photographs(
            facts["grid"],
            facts["channels"],
            facts["frames"],
            aligned=facts["aligned"],
            by_hand=facts["by_hand"],
            sparing=is_sparing(settings.strategy, facts["grid"]),
            direct=settings.strategy == "direct",
        )
        height, width = facts["grid"]
        self.pixels = height * width

    def _show_result(self) -> None:
        """Show the transport of a finished scan."""
        T = load(self.project.store, on_dark="mask", device=self._device)
        self.show_transport(T, Setup.of(self.project.store))

    def _look(self) -> None:
        """Read new files for a while, and take note of the state of the scan."""
        self._warnings.pop("folder", None)
        state = self.project.state
        store = None
        if state != "new":
            store = BlockStore.open(self.project.store)
            self.agreement.set_calibration(store)
        with self._open_rig() as rig:
            files = list(self._list_files(rig, store))
            self._progress = self._measure_progress(state, files, store)
            self._read_new(files, rig, store)
        if state == "final" and self.T is None:
            self._show_result()

    def _open_rig(self) -> contextlib.AbstractContextManager[Any]:
        """Open a rig that is worked by hand; others may be in use."""
        if self.project.kind == "folder":
            return self.project.rig()
        return contextlib.nullcontext()

    def _list_files(self, rig: Any, store: BlockStore | None) -> Iterator[ScanFile]:
        if rig is not None:
            return scan_files.photographs_by_hand(rig)
        if store is None:
            return scan_files.photographs_of_calibration(self.project.store)
        return scan_files.batches(store)

    def _measure_progress(
        self, state: str, files: list[ScanFile], store: BlockStore | None
    ) -> dict[str, Any]:
        """Return how much is done, of what, and the estimated seconds left."""
        done = len(files)
        total = self._calibration_photographs
        unit = "photographs of the calibration"
        if store is not None:
            plan = store.attributes["plan"]
            if self.project.kind == "folder":
                total = int(plan["photographs"])
                unit = "photographs"
            else:
                total = int(plan["patterns"])
                unit = "patterns"
                done = round(total * done / store.layout.blocks("columns"))
            if store.final:
                done = int(store.attributes["patterns"])
                total = done
        total = max(total, done)
        progress: dict[str, Any] = {
            "state": state,
            "done": done,
            "total": total,
            "what": unit,
            "left": _seconds_left(files, done, total),
        }
        calibration = self.agreement.calibration
        if calibration is not None:
            progress["coverage"] = float(np.mean(calibration.resampling.coverage > 0))
            progress["saturated"] = 1.0 - valid_share(calibration.white)
        return progress

    def _read_new(self, files: list[ScanFile], rig: Any, store: BlockStore | None) -> None:
        """Read files that are new or have changed, the newest first, for a while."""
        end = time.monotonic() + READING_SECONDS
        newest_first = _newest_first(files)
        # The first photograph decides on the shape and type of all others.
        for file in [*newest_first[-1:], *newest_first[:-1]]:
            is_read = self._times_read.get(file.path) == file.time
            if not is_read and time.monotonic() < end:
                self._times_read[file.path] = file.time
                self._read(file, rig, store)

    def _read(self, file: ScanFile, rig: Any, store: BlockStore | None) -> None:
        """Read a photograph or a batch, and show it."""
        name = f"photograph {file.number}"
        self._warnings.pop(name, None)
        if file.shot is None and store is not None:
            codes = scan_files.read_batch(store, file.number)
            self._add_preview(f"batch {file.number + 1}", file, codes, {})
            return
        try:
            codes = self._reader.read(name, file, rig)
        except LtclError as error:
            self._warnings[name] = _one_line(error)
            return
        facts = {"histogram": histogram(codes), "seconds": None}
        if file.shot is not None:
            self._check(name, file.shot, codes)
            facts["seconds"] = file.shot.seconds
        self._add_preview(name, file, codes, facts)

    def _check(self, name: str, shot: Shot, codes: np.ndarray) -> None:
        """Compare a photograph with the others of its pattern."""
        self._warnings.pop(shot.pattern, None)
        self.agreement.add(shot, codes)
        saturation = self.agreement.saturation(name, shot, codes)
        if saturation:
            self._warnings[name] = saturation
        deviation = self.agreement.deviation(shot.pattern)
        if deviation:
            self._warnings[shot.pattern] = deviation

    def _add_preview(
        self, name: str, file: ScanFile, codes: np.ndarray, facts: dict[str, Any]
    ) -> None:
        self._preview_count += 1
        self._previews[name] = Preview(
            number=self._preview_count,
            facts={"name": name, "time": file.time, **facts},
            picture=thumbnail(codes),
        )
        if len(self._previews) > MAX_PREVIEWS:
            oldest = min(self._previews, key=self._time_of)
            del self._previews[oldest]

    def _time_of(self, name: str) -> float:
        return self._previews[name].facts["time"]


class PhotographAgreement:
    """Photographs by hand against the others of their patterns, once the camera is calibrated."""

    def __init__(self) -> None:
        self.calibration: Calibration | None = None
        # Seconds and sampled codes, by pattern and by number of the photograph.
        self._samples: defaultdict[str, dict[int, tuple[float, np.ndarray]]] = defaultdict(dict)

    def set_calibration(self, store: BlockStore) -> None:
        """Read the calibration of a store, once."""
        if self.calibration is None:
            self.calibration = Calibration.of(store)

    def add(self, shot: Shot, codes: np.ndarray) -> None:
        """Take a photograph, which may replace an earlier one."""
        self._samples[shot.pattern][shot.number] = (shot.seconds, sample(codes))

    def saturation(self, name: str, shot: Shot, codes: np.ndarray) -> str | None:
        """Return a warning if much of a photograph is saturated in the shortest exposure."""
        if self.calibration is None:
            return None
        share = float(np.mean(codes >= SATURATION_LEVEL))
        is_shortest = shot.seconds <= self.calibration.exposures[0]
        if share > MAX_SATURATED_SHARE and is_shortest:
            return f"{name}: {share:.0%} are saturated in the shortest exposure"
        return None

    def deviation(self, pattern: str) -> str | None:
        """Return a warning if the photographs of a pattern contradict each other."""
        calibration = self.calibration
        if calibration is None:
            return None
        numbers = []
        seconds = []
        samples = []
        for number, (exposure, codes) in sorted(self._samples[pattern].items()):
            numbers.append(number)
            seconds.append(exposure)
            samples.append(codes)
        if len({*seconds}) < 2:
            return None
        deviation = find_deviation(samples, seconds, calibration.camera)
        return deviation.describe(numbers) if deviation else None


def _newest_first(files: list[ScanFile]) -> list[ScanFile]:
    return sorted(files, key=lambda file: -file.time)


def _seconds_left(files: list[ScanFile], done: int, total: int) -> float | None:
    """Estimate the seconds left by the pace of the newest files; None if it is unknown."""
    times = [file.time for file in _newest_first(files)[:PACE_FILES]]
    if not 0 < done < total or len(times) < 2:
        return None
    seconds_of_file = (times[0] - times[-1]) / (len(times) - 1)
    # A file is a photograph, or a batch of several patterns.
    seconds_of_unit = seconds_of_file * len(files) / done
    return seconds_of_unit * (total - done)


def thumbnail(codes: np.ndarray) -> np.ndarray:
    """Return a small picture, uint8, of codes in [0, 1]."""
    # Ceiling of the quotient.
    step = -(-max(codes.shape[:2]) // PREVIEW_SIDE)
    return np.rint(255 * codes[::step, ::step].clip(0, 1)).astype(np.uint8)


def histogram(codes: np.ndarray) -> np.ndarray:
    """Return shares of pixels, by code."""
    step = 1 + codes.shape[0] // HISTOGRAM_ROWS
    counts, _ = np.histogram(codes[::step], HISTOGRAM_BINS, (0.0, 1.0))
    return counts / counts.sum()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
