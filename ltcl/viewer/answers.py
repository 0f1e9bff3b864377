# SPDX-License-Identifier: BSD-3-Clause
"""`ViewerScene`: the answers of the library to the page, with one method for each question."""

from __future__ import annotations

import inspect
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.errors import InputError, InputTypeError
from ltcl.images.encoding import from_linear, to_linear
from ltcl.images.pictures import BITS, RESIZES, as_picture
from ltcl.tasks import report
from ltcl.tasks.compensation import Compensator, compensate
from ltcl.tasks.separation import separate
from ltcl.transport import frames as layout
from ltcl.transport.first_bounce import ENTRIES
from ltcl.transport.projectors import CombinedTransport
from ltcl.viewer.messages import LARGEST_FILE
from ltcl.viewer.pictures import KeptPictures, decode_file

# Facts, and pictures by their names.
Reply = tuple[dict[str, Any], dict[str, np.ndarray]]
# The callback of `ltcl.solve`: iteration and relative residual.
Callback = Callable[[int, float], None]
# Questions that take a solve, which calls back.
LONG_QUESTIONS = ("bounces", "compensate")
QUESTIONS = (
    *LONG_QUESTIONS,
    "adjust",
    "column",
    "row",
    "relight",
    "pictures",
    "upload",
    "result",
    "projector",
)
# Pictures of a compensation.
COMPENSATION_PICTURES = ("pattern", "appearance", "target", "out_of_reach")
COMPENSATION_FACTS = ("error", "gain", "clipped", "gap", "transport_error")
RESULT_FILES = (
    "report.json",
    "pattern.png",
    "codes.png",
    *(f"{name}.exr" for name in COMPENSATION_PICTURES),
)
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


class ViewerScene:
    """T and what is shown of it.

    Methods take the fields of a question, and raise LtclError for anything else. T is None if there
    is none yet, or only patterns are shown: then nothing is computed. `setup` is the
    `ltcl.acquisition.Setup` of a measured T; a combination of scans has its own. `pattern`
    (h, w[, 3]) is the light of the projector, of at most `white`, or uint8 codes. A question has at
    most so many `pixels`.
    """

    page = "index.html"

    def __init__(self, T: Any, title: str, pictures: Mapping[str, np.ndarray], setup: Any) -> None:
        self.title = title
        self.T: Any = None
        self._released: Any = None
        self.setup: Any = None
        self.pattern: Any = None
        self.white = 1.0
        self.pixels = 1
        self._has_std = False
        self._compensation: tuple[Any, dict[str, Any]] | None = None
        # Prepared for the bounds of the last adjustment.
        self._compensator: Compensator | None = None
        self._pictures = KeptPictures(len(pictures))
        if T is not None:
            self.show_transport(T, setup)
        for name, picture in pictures.items():
            self.add(name, as_picture(name, picture))

    def show_transport(self, T: Any, setup: Any) -> None:
        """Show a transport from now on, while other threads may ask."""
        has_entries = all(isinstance(matrix, ENTRIES) for matrix in T.matrices)
        self._has_std = T.is_square and (has_entries or T.measured_noise is not None)
        self.setup = _setup_of_several(T) if setup is None else setup
        self.pattern = np.ones(T.grid, np.float32)
        self.white = 1.0
        self.pixels = max(T.shape)
        # The last assignment: other threads see nothing of the transport, or all.
        self.T = T

    def release(self) -> None:
        """Let go of the transport, and of all that was made with it on the device."""
        self._compensation = None
        self._compensator = None
        if self.T is not None:
            self._released = weakref.ref(self.T)
        self.T = None

    def resume(self) -> bool:
        """Take the transport up again; False if nobody else has kept it."""
        if self.T is None and self._released is not None:
            self.T = self._released()
        return self.T is not None

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
                "projectors": self._projectors(),
                "extensions": [*BITS],
                "largest_file": LARGEST_FILE,
            }
        return facts

    def _projectors(self) -> list[dict[str, Any]]:
        """Name, grid and first column of each of several projectors in a pattern."""
        if not isinstance(self.T, CombinedTransport):
            return []
        montage = self.T.montage
        numbered = [f"projector {number + 1}" for number in range(len(montage.grids))]
        names: Sequence[str] = getattr(self.setup, "names", numbered)
        projectors = []
        for name, grid, left in zip(names, montage.grids, montage.lefts, strict=True):
            projectors.append({"name": name, "grid": grid, "left": left})
        return projectors

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
            light = self._pictures.get(picture).for_projector[resize]
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
            image = self._pictures.get(picture).for_camera[resize]
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
        desired = self._pictures.get(picture)
        start = time.perf_counter()
        result = compensate(
            self.T,
            desired.for_camera[resize],
            background=self._ambient,
            callback=callback,
            gain=gain,
            bounds=bounds,
        )
        facts = {name: getattr(result, name) for name in COMPENSATION_FACTS}
        facts["seconds"] = time.perf_counter() - start
        solves = _all_solves(result)
        methods = [solve["method"] for solve in solves]
        facts["method"] = ", ".join(dict.fromkeys(methods))
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
        light = self._pictures.get(picture).for_camera[resize]
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
        if self._ambient is not None:
            appearance = appearance + self._ambient
        if self.T.background is not None:
            shape = layout.PictureLayout(False, None, appearance.ndim == 3)
            appearance = appearance + shape.pack(self.T.background, self.T.camera_grid)
        return facts, {"pattern": pattern, "appearance": appearance.astype(np.float32, copy=False)}

    @property
    def _ambient(self) -> np.ndarray | None:
        """Light under a black projector; None if the projector was not measured."""
        if self.setup is None:
            return None
        return self.setup.ambient

    def _prepared(self, bounds: Any) -> Compensator:
        """The compensator for these bounds, which is made at the first question."""
        compensator = self._compensator
        if compensator is None or compensator.T is not self.T:
            compensator = Compensator(
                self.T,
                background=self._ambient,
                bounds=bounds,
                deadline_ms=ADJUST_DEADLINE_MS,
                encode="linear",
                dtype="float32",
            )
            self._compensator = compensator
        elif compensator.bounds != checks.interval("bounds", bounds):
            compensator.bounds = bounds
        return compensator

    def _uncompensated(self, light: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the scene under a picture as the pattern, made as bright as the target."""
        seen = self.T @ light
        mean = max(seen.mean(), np.finfo(np.float32).tiny)
        seen *= np.float32(target.mean() / mean)
        return seen

    def pictures(self) -> Reply:
        """Return names and numbers of the kept pictures."""
        return {"pictures": self._pictures.entries()}, {}

    def projector(self) -> Reply:
        """Take note of a projector window that shows the pattern; the server sends the next one."""
        return {}, {}

    def add(self, name: str, picture: np.ndarray) -> int:
        """Keep a picture on both grids; return its number."""
        return self._pictures.add(name, picture, self.T)

    def upload(self, name: Any, content: Any) -> Reply:
        """Keep the picture of a file, of which `content` are the bytes (size,), uint8."""
        picture = decode_file(name, content)
        shape = picture.reshape(*picture.shape[:2], -1).shape
        return {"picture": self.add(name, picture), "name": name, "shape": shape}, {}

    def result(self, name: Any) -> Reply:
        """Return a file of the last compensation by its name, as bytes (size,), uint8."""
        checks.one_of("name", name, RESULT_FILES)
        content = np.frombuffer(self._result_file(name), np.uint8)
        return {"name": name}, {"content": content}

    def _result_file(self, name: str) -> bytes:
        if self._compensation is None:
            raise InputError(f"name is {name!r}, but nothing was compensated yet")
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


def _setup_of_several(T: Any) -> Any:
    """The codes of the projectors of a combination of scans; None for any other T."""
    if not isinstance(T, CombinedTransport) or not T.displays:
        return None
    # The import takes a second.
    from ltcl.acquisition.projectors import CombinedSetup

    return CombinedSetup.of(T)


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
