# SPDX-License-Identifier: BSD-3-Clause
"""`Scene`: what the library answers to the page, with one method for each thing that it may ask."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.errors import InputError, InputTypeError, LtclError
from ltcl.images.encoding import from_linear, to_linear
from ltcl.images.pictures import BITS, as_picture
from ltcl.tasks import report
from ltcl.tasks.compensation import compensate
from ltcl.tasks.separation import separate
from ltcl.transport import frames as layout
from ltcl.transport.first_bounce import ENTRIES

Reply = tuple[dict[str, Any], dict[str, np.ndarray]]  # facts and pictures
Callback = Callable[[int, float], None]  # of `ltcl.solve`
LONG = ("bounces", "compensate")  # solves, which call back
PICTURES = ("pattern", "appearance", "target", "out_of_reach")  # of a compensation
LARGEST_FILE, LARGEST_PICTURE = 64 << 20, 3 << 29  # bytes; decoded, 64 million pixels
UPLOADS = 16  # that are kept
_BOUNCES = 16
_STEPS = (
    65535  # of light between black and white, of which each has a code: a table in place of powers
)
_CODES = from_linear(np.linspace(0, 1, _STEPS + 1, dtype=np.float32), "srgb", 8, is_float=False)


class Scene:
    """T and what is shown of it; methods take what a question holds, and raise LtclError for anything else.

    T is None where there is none yet, or only patterns are shown: then nothing is computed. `setup`
    is the `ltcl.acquisition.Setup` of a measured T. `pattern` (h, w[, 3]) is the light that the
    projector has now, of at most `white`, or uint8 codes. `questions` may be asked, the largest of
    so many `pixels`.
    """

    page = "index.html"
    questions: tuple[str, ...] = (*LONG, "column", "row", "relight", "pictures", "projector")

    def __init__(self, T: Any, title: str, pictures: Mapping[str, np.ndarray], setup: Any) -> None:
        self.T, self.title, self.setup = T, title, setup
        self.pattern: Any = None
        self.white, self.pixels = 1.0, 1
        if T is not None:
            self.pattern, self.pixels = np.ones(T.grid, np.float32), max(T.shape)
            entries = all(isinstance(matrix, ENTRIES) for matrix in T.matrices)
            self._shows_noise = T.is_square and (entries or T.measured_noise is not None)
        self._pictures: dict[
            int, tuple[str, np.ndarray, np.ndarray]
        ] = {}  # for the camera, the projector
        self._given, self._count = len(pictures), 0
        for name, picture in pictures.items():
            self.add(name, as_picture(name, picture))
        self._compensation: tuple[Any, dict[str, Any]] | None = None

    def hello(self) -> dict[str, Any]:
        """What a page has to know; `grid` is None where there is no T."""
        facts: dict[str, Any] = {name: name in self.questions for name in ("scan", "next")}
        facts |= {"title": self.title, "grid": None}
        if (T := self.T) is not None:
            facts |= {
                name: getattr(T, name) for name in ("grid", "camera_grid", "channels", "error")
            }
            facts |= {"device": T.device.name, "square": T.is_square, "compressed": T.is_compressed}
        return facts

    def answer(self, do: str, asked: dict[str, Any], callback: Callback) -> Reply:
        """The answer to a question by name; `callback` is called between the steps of a solve."""
        method = getattr(self, checks.one_of("do", do, self.questions))
        try:
            bound = inspect.signature(method).bind(
                **asked, **({"callback": callback} if do in LONG else {})
            )
        except TypeError as error:
            raise InputTypeError(f"{do}: {error}") from None
        return method(*bound.args, **bound.kwargs)

    def column(self, pixel: Any) -> Reply:
        """What one projector pixel lights."""
        return {}, {"picture": self.T @ _unit(pixel, self.T.grid)}

    def row(self, pixel: Any) -> Reply:
        """How much each projector pixel adds to one camera pixel."""
        T = self.T
        unit = _unit(pixel, T.camera_grid)
        columns, shape = layout.unpack("pixel", unit, T.camera_grid, T.channels)
        columns = [np.concatenate(columns)] if T.couples else columns
        rows = [A.T.matmat(x) for A, x in zip(T.operators, columns, strict=True)]
        return {}, {"pattern": shape.pack(rows, T.grid)}

    def relight(self, pattern: Any = None, picture: Any = None) -> Reply:
        """The picture under a pattern, sRGB codes, or a picture, shown from now on; or the present."""
        if pattern is None:
            light = self.pattern if picture is None else self._picture(picture)[2]
        else:
            codes = checks.shape(
                "pattern", checks.real("pattern", pattern), self.T.grid, (*self.T.grid, 3)
            )
            if self.T.channels == 1 and codes.ndim == 3 and (codes == codes[..., :1]).all():
                codes = codes[..., 0]  # a product in place of three
            light = to_linear(codes, "auto")
        seen = self.T @ light
        if light is not self.pattern:
            self.pattern, self.white = light, 1.0
        return {}, {"picture": seen} | ({"pattern": light} if pattern is None else {})

    def bounces(self, callback: Callback, picture: Any = None, count: Any = 4) -> Reply:
        """Direct light and bounces of a picture, or of what the current pattern looks like."""
        checks.count("count", count, least=0, most=_BOUNCES)
        image = self.T @ self.pattern if picture is None else self._picture(picture)[1]
        result = separate(self.T, image, count, callback=callback)
        numbered = {f"bounce_{k}": bounce for k, bounce in enumerate(result.bounces, 1)}
        light = {"direct": result.direct, **numbered, "rest": result.rest}
        whole = float(np.sum(image, dtype=np.float64)) or 1.0
        shares = [float(np.sum(part, dtype=np.float64)) / whole for part in light.values()]
        if self._shows_noise:
            deviations = zip(
                ["direct", *numbered], [result.std.direct, *result.std.bounces], strict=True
            )
            light |= {f"{name}_std": deviation for name, deviation in deviations}
        return {"shares": shares}, light

    def compensate(
        self, callback: Callback, picture: Any, gain: Any = 1.0, bounds: Any = (0, 1)
    ) -> Reply:
        """The pattern under which the scene looks like a picture; the projector shows it from now on."""
        name, desired, shown = self._picture(picture)
        asked, start = {"gain": gain, "bounds": bounds}, time.perf_counter()
        ambient = None if self.setup is None else self.setup.ambient
        c = compensate(self.T, desired, background=ambient, callback=callback, **asked)
        facts = {
            key: getattr(c, key) for key in ("error", "gain", "clipped", "gap", "transport_error")
        }
        facts["seconds"], solves = time.perf_counter() - start, report.solution(c.solution)
        solves += [each for each in report.solution(c.limited) if each not in solves]
        facts["method"] = ", ".join(dict.fromkeys(solve["method"] for solve in solves))
        facts["products"] = sum(solve["products"] for solve in solves)
        facts["residuals"] = max((solve["residuals"] for solve in solves), key=len)
        self.pattern, self.white = c.pattern, max(float(bounds[1]), 0.0) or 1.0
        known = {
            "title": self.title,
            "versions": report.versions(),
            "device": report.device(self.T.device),
        }
        known |= {"picture": name, **asked, **facts, "white": self.white, "solves": solves}
        self._compensation = c, known
        plain = self.T @ shown  # the picture itself as a pattern, made as bright as the target
        plain *= np.float32(c.target.mean() / max(plain.mean(), np.finfo(np.float32).tiny))
        return facts, {name: getattr(c, name) for name in PICTURES} | {"uncompensated": plain}

    def pictures(self) -> Reply:
        """Names and numbers of the pictures that there are."""
        return {
            "pictures": [{"picture": k, "name": name} for k, (name, *_) in self._pictures.items()]
        }, {}

    def projector(self) -> Reply:
        """A window that is to show the pattern, or has shown it; the server sends the next one."""
        return {}, {}

    def add(self, name: str, picture: np.ndarray) -> int:
        """Keep a picture, on the grids of camera and projector; its number."""
        grids = (self.T.camera_grid, self.T.grid)
        sizes = [
            picture if picture.shape[:2] == grid else images.resize(picture, grid) for grid in grids
        ]
        self._count += 1
        self._pictures[self._count] = name, sizes[0], sizes[1]
        if self._count > self._given + UPLOADS:
            del self._pictures[self._count - UPLOADS]
        return self._count

    def upload(self, name: str, content: bytes | bytearray) -> dict[str, Any]:
        """Keep the picture of a file; InputError, before it is decoded, where that has too many pixels."""
        if self.T is None:
            raise InputError(f"{self.title} has no transport, or none yet; pictures are for one")
        suffix = checks.one_of("extension", Path(name).suffix.lower(), BITS)
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"picture{suffix}"
            path.write_bytes(content)
            try:
                picture = images.read(path, memory=LARGEST_PICTURE)
            except LtclError as error:
                raise InputError(str(error).removeprefix(f"{path}: ")) from None
        shape = [*picture.shape, 1][:3]
        return {"picture": self.add(name, picture), "name": name, "shape": shape}

    def result(self, name: str) -> bytes | None:
        """A file of the last compensation, by its name; None where there is none."""
        files = ("report.json", "pattern.png", "codes.png", *(f"{each}.exr" for each in PICTURES))
        if self._compensation is None or name not in files:
            return None
        c, facts = self._compensation
        if name == "report.json":
            return report.dumps(facts).encode()
        picture, encoding = getattr(c, name[:-4], c.pattern), "auto"
        if name == "codes.png" and self.setup is not None:
            picture, encoding = self.codes(c.pattern, facts["white"]) / np.float32(255), "linear"
        elif name.endswith(".png"):
            picture = c.pattern / np.float32(facts["white"])
        with TemporaryDirectory() as folder:
            images.write(path := Path(folder) / name, picture, encoding=encoding)
            return path.read_bytes()

    def codes(self, pattern: np.ndarray, white: float) -> np.ndarray:
        """What a projector has to show, uint8 on its pixels: codes of the measured one, else sRGB."""
        if pattern.dtype == np.uint8:  # they are such
            return pattern
        if self.setup is None:
            steps = np.clip(pattern * np.float32(_STEPS / white) + np.float32(0.5), 0, _STEPS)
            return _CODES[steps.astype(np.uint16)]
        return from_linear(self.setup.codes(pattern), "linear", 8, is_float=False)

    def _picture(self, number: Any) -> tuple[str, np.ndarray, np.ndarray]:
        return self._pictures[checks.one_of("picture", number, self._pictures)]


def _unit(pixel: Any, grid: tuple[int, int]) -> np.ndarray:
    """Light, or sight, of one pixel."""
    if not isinstance(pixel, list) or len(pixel) != 2:
        raise InputError(f"pixel is {checks.shown(pixel)}; it must be [row, column]")
    place = tuple(
        checks.count("pixel", n, least=0, most=size - 1)
        for n, size in zip(pixel, grid, strict=True)
    )
    unit = np.zeros(grid, np.float32)
    unit[place] = 1.0
    return unit
