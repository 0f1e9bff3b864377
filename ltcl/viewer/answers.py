# SPDX-License-Identifier: BSD-3-Clause
"""`ViewerScene`: the answers of the library to the page, with one method for each question."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.images.encoding import from_linear, to_linear
from ltcl.images.pictures import BITS, RESIZES, as_picture
from ltcl.tasks import report
from ltcl.tasks.compensation import Compensator, compensate
from ltcl.tasks.separation import separate
from ltcl.transport import frames as layout
from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.projectors import CombinedTransport

# Facts, and pictures by their names.
Reply = tuple[dict[str, Any], dict[str, np.ndarray]]
# The callback of `ltcl.solve`: iteration and relative residual.
Callback = Callable[[int, float], None]
# Questions that take a solve, which calls back.
LONG_QUESTIONS = ("bounces", "compensate")
QUESTIONS = (*LONG_QUESTIONS, "adjust", "column", "row", "relight", "pictures", "projector")
# Pictures of a compensation.
COMPENSATION_PICTURES = ("pattern", "appearance", "target", "out_of_reach")
COMPENSATION_FACTS = ("error", "gain", "clipped", "gap", "transport_error")
RESULT_FILES = (
    "report.json",
    "pattern.png",
    "codes.png",
    *(f"{name}.exr" for name in COMPENSATION_PICTURES),
)
# Bytes of a file, and of a decoded picture: 64 million pixels.
LARGEST_FILE = 64 << 20
LARGEST_PICTURE = 3 << 29
# Uploaded pictures that are kept; an older one is dropped.
MAX_UPLOADS = 16
MAX_BOUNCES = 16
# Milliseconds of projected steps while a slider moves.
ADJUST_DEADLINE_MS = 30.0
# What becomes of a picture of other proportions, unless the page chooses: nothing is distorted.
DEFAULT_RESIZE = "crop"
# Steps of light between black and white, each with a code: a table is faster than powers.
LIGHT_STEPS = 65535
SRGB_CODES = from_linear(
    np.linspace(0, 1, LIGHT_STEPS + 1, dtype=np.float32), "srgb", 8, is_float=False
)


@dataclass(frozen=True, kw_only=True)
class KeptPicture:
    """A picture on the grids of camera and projector, by the way of `RESIZES` that it took."""

    name: str
    for_camera: dict[str, np.ndarray]
    for_projector: dict[str, np.ndarray]


class ViewerScene:
    """T and what is shown of it.

    Methods take the fields of a question, and raise LtclError for anything else. T is None if there
    is none yet, or only patterns are shown: then nothing is computed. `setup` is the
    `ltcl.acquisition.Setup` of a measured T. `pattern` (h, w[, 3]) is the light of the projector,
    of at most `white`, or uint8 codes. A question has at most so many `pixels`.
    """

    page = "index.html"

    def __init__(self, T: Any, title: str, pictures: Mapping[str, np.ndarray], setup: Any) -> None:
        self.title = title
        self.T: Any = None
        self.setup: Any = None
        self.pattern: Any = None
        self.white = 1.0
        self.pixels = 1
        self._has_std = False
        self._compensation: tuple[Any, dict[str, Any]] | None = None
        # Prepared for the bounds of the last adjustment.
        self._compensator: tuple[Any, Compensator] | None = None
        self._pictures: dict[int, KeptPicture] = {}
        self._picture_count = 0
        self._first_pictures = len(pictures)
        if T is not None:
            self.show_transport(T, setup)
        for name, picture in pictures.items():
            self.add(name, as_picture(name, picture))

    def show_transport(self, T: Any, setup: Any) -> None:
        """Show a transport from now on, while other threads may ask."""
        has_entries = all(isinstance(matrix, ENTRIES) for matrix in T.matrices)
        self._has_std = T.is_square and (has_entries or T.measured_noise is not None)
        self.setup = setup
        self.pattern = np.ones(T.grid, np.float32)
        self.white = 1.0
        self.pixels = max(T.shape)
        # The last assignment: other threads see nothing of the transport, or all.
        self.T = T

    @property
    def questions(self) -> tuple[str, ...]:
        """Questions that may be asked now."""
        return QUESTIONS

    def hello(self) -> dict[str, Any]:
        """Return what a page has to know; `grid` is None if there is no T."""
        questions = self.questions
        facts: dict[str, Any] = {
            "scan": "scan" in questions,
            "next": "next" in questions,
            "title": self.title,
            "grid": None,
        }
        T = self.T
        if T is not None:
            facts |= {
                "grid": T.grid,
                "camera_grid": T.camera_grid,
                "channels": T.channels,
                "error": T.error,
                "device": T.device.name,
                "square": T.is_square,
                "bounces": T.scene.is_square,
                "compressed": T.is_compressed,
                "extensions": [*BITS],
            }
        return facts

    def answer(self, do: str, asked: dict[str, Any], callback: Callback) -> Reply:
        """Answer a question by name; `callback` is called between the steps of a solve."""
        method = getattr(self, checks.one_of("do", do, self.questions))
        arguments = {"callback": callback} if do in LONG_QUESTIONS else {}
        try:
            bound = inspect.signature(method).bind(**asked, **arguments)
        except TypeError as error:
            raise InputTypeError(f"{do}: {error}") from None
        return method(*bound.args, **bound.kwargs)

    def column(self, pixel: Any) -> Reply:
        """Return the light of one projector pixel."""
        return {}, {"picture": self.T @ _unit_picture(pixel, self.T.grid)}

    def row(self, pixel: Any) -> Reply:
        """Return the part of each projector pixel in one camera pixel."""
        T = self.T
        unit = _unit_picture(pixel, T.camera_grid)
        columns, shape = layout.unpack("pixel", unit, T.camera_grid, T.channels)
        if T.couples:
            columns = [np.concatenate(columns)]
        rows = []
        for operator, column in zip(T.operators, columns, strict=True):
            rows.append(operator.T.matmat(column))
        return {}, {"pattern": shape.pack(rows, T.grid)}

    def relight(
        self, pattern: Any = None, picture: Any = None, resize: Any = DEFAULT_RESIZE
    ) -> Reply:
        """Return the picture under a pattern, and let the projector show that.

        The pattern is one of sRGB codes, a kept picture, or the present one.
        """
        checks.one_of("resize", resize, RESIZES)
        if pattern is not None:
            light = self._light_of_codes(pattern)
        elif picture is not None:
            light = self._picture(picture).for_projector[resize]
        else:
            light = self.pattern
        shown = {"picture": self.T @ light}
        if light is not self.pattern:
            self.pattern = light
            self.white = 1.0
        if pattern is None:
            shown["pattern"] = light
        return {}, shown

    def _light_of_codes(self, pattern: Any) -> np.ndarray:
        grid = self.T.grid
        codes = checks.real("pattern", pattern)
        codes = checks.shape("pattern", codes, grid, (*grid, 3))
        is_grey = codes.ndim == 3 and (codes == codes[..., :1]).all()
        if self.T.channels == 1 and is_grey:
            # One product instead of three.
            codes = codes[..., 0]
        return to_linear(codes, "auto")

    def bounces(
        self,
        callback: Callback,
        picture: Any = None,
        count: Any = 4,
        resize: Any = DEFAULT_RESIZE,
    ) -> Reply:
        """Return direct light and bounces of a picture, or of the scene under the pattern."""
        checks.count("count", count, least=0, most=MAX_BOUNCES)
        checks.one_of("resize", resize, RESIZES)
        if picture is None:
            image = self.T @ self.pattern
        else:
            image = self._picture(picture).for_camera[resize]
        result = separate(self.T, image, count, callback=callback)
        bounces = {f"bounce_{k}": bounce for k, bounce in enumerate(result.bounces, 1)}
        light = {"direct": result.direct, **bounces, "rest": result.rest}
        whole = _sum(image) or 1.0
        shares = [_sum(picture) / whole for picture in light.values()]
        if self._has_std:
            deviations = [result.std.direct, *result.std.bounces]
            for name, deviation in zip(["direct", *bounces], deviations, strict=True):
                light[f"{name}_std"] = deviation
        return {"shares": shares}, light

    def compensate(
        self,
        callback: Callback,
        picture: Any,
        gain: Any = 1.0,
        bounds: Any = (0, 1),
        resize: Any = DEFAULT_RESIZE,
    ) -> Reply:
        """Return the pattern for a picture, and let the projector show it."""
        checks.one_of("resize", resize, RESIZES)
        desired = self._picture(picture)
        start = time.perf_counter()
        result = compensate(
            self.T,
            desired.for_camera[resize],
            background=None if self.setup is None else self.setup.ambient,
            callback=callback,
            gain=gain,
            bounds=bounds,
        )
        facts = {name: getattr(result, name) for name in COMPENSATION_FACTS}
        facts["seconds"] = time.perf_counter() - start
        solves = _all_solves(result)
        facts["method"] = ", ".join(dict.fromkeys(solve["method"] for solve in solves))
        facts["products"] = sum(solve["products"] for solve in solves)
        facts["residuals"] = max((solve["residuals"] for solve in solves), key=len)
        self.pattern = result.pattern
        self.white = max(float(bounds[1]), 0.0) or 1.0
        known = {
            "title": self.title,
            "versions": report.versions(),
            "device": report.device(self.T.device),
            "picture": desired.name,
            "resize": resize,
            "gain": gain,
            "bounds": bounds,
            **facts,
            "white": self.white,
            "solves": solves,
        }
        self._compensation = (result, known)
        pictures = {name: getattr(result, name) for name in COMPENSATION_PICTURES}
        plain = desired.for_projector[resize]
        pictures["uncompensated"] = self._uncompensated(plain, result.target)
        return facts, pictures

    def adjust(
        self, picture: Any, gain: Any, bounds: Any = (0, 1), resize: Any = DEFAULT_RESIZE
    ) -> Reply:
        """Return the pattern for a picture while a slider moves, as good as there is time for.

        It comes from a prepared compensator, whose times are among the facts, in seconds.
        """
        checks.one_of("resize", resize, RESIZES)
        checks.number("gain", gain, above=0.0)
        light = self._picture(picture).for_camera[resize]
        compensator = self._prepared(bounds)
        compensator.gain = float(gain)
        pattern = compensator(light)
        judged = compensator.judge()
        self.pattern = pattern
        self.white = max(float(bounds[1]), 0.0) or 1.0
        times = compensator.statistics
        facts = {
            "error": judged.error,
            "clipped": judged.clipped,
            "gain": float(gain),
            "p50": times.latency_p50,
            "p99": times.latency_p99,
        }
        appearance = self.T @ pattern
        if self.setup is not None:
            appearance = appearance + self.setup.ambient
        return facts, {"pattern": pattern, "appearance": appearance.astype(np.float32, copy=False)}

    def _prepared(self, bounds: Any) -> Compensator:
        """The compensator for these bounds; made anew where they are others."""
        if self._compensator is None or self._compensator[0] != (self.T, bounds):
            compensator = Compensator(
                self.T,
                background=None if self.setup is None else self.setup.ambient,
                bounds=bounds,
                deadline_ms=ADJUST_DEADLINE_MS,
                encode="linear",
                dtype="float32",
            )
            self._compensator = ((self.T, bounds), compensator)
        return self._compensator[1]

    def _uncompensated(self, light: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the scene under a picture as the pattern, made as bright as the target."""
        seen = self.T @ light
        mean = max(seen.mean(), np.finfo(np.float32).tiny)
        seen *= np.float32(target.mean() / mean)
        return seen

    def pictures(self) -> Reply:
        """Return names and numbers of the kept pictures."""
        entries = []
        for number, picture in self._pictures.items():
            entries.append({"picture": number, "name": picture.name})
        return {"pictures": entries}, {}

    def projector(self) -> Reply:
        """Take note of a projector window that shows the pattern; the server sends the next one."""
        return {}, {}

    def add(self, name: str, picture: np.ndarray) -> int:
        """Keep a picture on both grids; return its number."""
        for_camera = _resized(picture, self.T.camera_grid)
        for_projector = for_camera
        if self.T.grid != self.T.camera_grid:
            for_projector = self._for_projectors(picture)
        self._picture_count += 1
        number = self._picture_count
        self._pictures[number] = KeptPicture(
            name=name, for_camera=for_camera, for_projector=for_projector
        )
        if number > self._first_pictures + MAX_UPLOADS:
            del self._pictures[number - MAX_UPLOADS]
        return number

    def _for_projectors(self, picture: np.ndarray) -> dict[str, np.ndarray]:
        """The picture on the projector's grid, or on that of each of several, side by side."""
        if not isinstance(self.T, CombinedTransport):
            return _resized(picture, self.T.grid)
        parts = [_resized(picture, grid) for grid in self.T.montage.grids]
        joined = {}
        for way in parts[0]:
            joined[way] = self.T.join([part[way] for part in parts])
        return joined

    def upload(self, name: str, content: bytes | bytearray) -> dict[str, Any]:
        """Keep the picture of a file.

        InputError, before it is decoded, if it has too many pixels.
        """
        if self.T is None:
            problem = f"{self.title} has no transport, or none yet"
            raise InputError(f"{problem}; pictures are for one")
        suffix = checks.one_of("extension", Path(name).suffix.lower(), BITS)
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"picture{suffix}"
            path.write_bytes(content)
            try:
                picture = images.read(path, memory=LARGEST_PICTURE)
            except LtclError as error:
                raise InputError(str(error).removeprefix(f"{path}: ")) from None
        shape = picture.reshape(*picture.shape[:2], -1).shape
        return {"picture": self.add(name, picture), "name": name, "shape": shape}

    def result(self, name: str) -> bytes | None:
        """Return a file of the last compensation by its name; None if there is none."""
        if self._compensation is None or name not in RESULT_FILES:
            return None
        result, facts = self._compensation
        if name == "report.json":
            return report.dumps(facts).encode()
        if name == "codes.png" and self.setup is not None:
            codes = self.codes(result.pattern, facts["white"])
            return _picture_file(name, codes / np.float32(255), "linear")
        if name.endswith(".png"):
            return _picture_file(name, result.pattern / np.float32(facts["white"]), "auto")
        return _picture_file(name, getattr(result, name.removesuffix(".exr")), "auto")

    def codes(self, pattern: np.ndarray, white: float) -> np.ndarray:
        """Return the uint8 codes for a projector: by its measured response, else sRGB."""
        if pattern.dtype == np.uint8:
            return pattern
        if self.setup is not None:
            return from_linear(self.setup.codes(pattern), "linear", 8, is_float=False)
        steps = pattern * np.float32(LIGHT_STEPS / white) + np.float32(0.5)
        return SRGB_CODES[np.clip(steps, 0, LIGHT_STEPS).astype(np.uint16)]

    def _picture(self, number: Any) -> KeptPicture:
        return self._pictures[checks.one_of("picture", number, self._pictures)]


def _unit_picture(pixel: Any, grid: tuple[int, int]) -> np.ndarray:
    """Return a picture of 1 at one pixel and 0 at all others."""
    if not isinstance(pixel, list) or len(pixel) != 2:
        raise InputError(f"pixel is {checks.shown(pixel)}; it must be [row, column]")
    row, column = pixel
    height, width = grid
    checks.count("pixel", row, least=0, most=height - 1)
    checks.count("pixel", column, least=0, most=width - 1)
    unit = np.zeros(grid, np.float32)
    unit[row, column] = 1.0
    return unit


def _resized(picture: np.ndarray, grid: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return a picture on a grid, by each way of `RESIZES`; one array where all are the same."""
    h, w = picture.shape[:2]
    if (h, w) == grid:
        return dict.fromkeys(RESIZES, picture)
    if h * grid[1] == w * grid[0]:
        return dict.fromkeys(RESIZES, images.resize(picture, grid))
    ways = {}
    for how in RESIZES:
        ways[how] = images.resize(picture, grid, how)
    return ways


def _sum(picture: np.ndarray) -> float:
    return float(np.sum(picture, dtype=np.float64))


def _all_solves(result: Any) -> list[dict[str, Any]]:
    """Return the solves without bounds and those within them, each once."""
    solves = report.solution(result.solution)
    for solve in report.solution(result.limited):
        if solve not in solves:
            solves.append(solve)
    return solves


def _picture_file(name: str, picture: np.ndarray, encoding: Any) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        images.write(path, picture, encoding=encoding)
        return path.read_bytes()
