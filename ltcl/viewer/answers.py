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
import OpenEXR
from PIL import Image

from ltcl import __version__, checks, images, layout, report
from ltcl.compensation import compensate
from ltcl.errors import FileError, InputError, InputTypeError, LtclError
from ltcl.first_bounce import ENTRIES
from ltcl.images.pictures import BITS, as_picture, decoding, from_linear, to_linear
from ltcl.separation import separate
from ltcl.transport import Transport

Reply = tuple[dict[str, Any], dict[str, np.ndarray]]  # facts and pictures
Callback = Callable[[int, float], None]  # of `ltcl.solve`
QUICK = ("column", "row", "relight", "pictures", "projector")  # a product at most
LONG = ("bounces", "compensate")
RESULTS = ("pattern.exr", "pattern.png", "codes.png", "appearance.exr", "target.exr", "out_of_reach.exr")
LARGEST_FILE, LARGEST_PICTURE = 64 << 20, 64_000_000  # bytes and pixels of an upload
_UPLOADS = 16  # pictures that are kept
_BOUNCES = 16


class Scene:
    """T and what is shown of it; methods take what a question holds, and raise InputError for anything else.

    `setup` is the `ltcl.acquisition.Setup` of a measured T. `pattern` (h, w[, 3]) is the light that the
    projector has now, of at most `white`.
    """

    def __init__(self, T: Transport, title: str, pictures: Mapping[str, np.ndarray], setup: Any) -> None:
        self.T, self.title, self.setup = T, title, setup
        self.pattern, self.white = np.ones(T.grid, np.float32), 1.0
        self._pictures: dict[int, tuple[str, np.ndarray, np.ndarray]] = {}  # for the camera, the projector
        self._named = self._last = 0
        for name, picture in pictures.items():
            self._named = self.add(name, as_picture(name, picture))
        self._compensation: tuple[Any, dict[str, Any]] | None = None

    def hello(self) -> dict[str, Any]:
        """What a page has to know of T."""
        T = self.T
        return {
            "title": self.title,
            "grid": T.grid,
            "camera_grid": T.camera_grid,
            "channels": T.channels,
            "square": T.is_square,
            "compressed": T.is_compressed,
            "error": T.error,
            "masked": int(T.masked.sum()),
            "noise": self._shows_noise(),
            "pictures": [name for name, *_ in self._pictures.values()],
            "device": T.device.name,
            "version": __version__,
            "scan": False,
            "measured": self.setup is not None,
        }

    def answer(self, do: str, asked: dict[str, Any], callback: Callable[[int, float], None]) -> Reply:
        """The answer to a question by name; `callback` is called between the steps of a solve."""
        method = getattr(self, checks.one_of("do", do, (*QUICK, *LONG)))
        parameters = inspect.signature(method).parameters
        for name in asked:
            if name not in parameters or name == "callback":
                raise InputTypeError(f"{do} has no {name[:40]!r}; it has {', '.join(parameters)}")
        for name, parameter in parameters.items():
            if parameter.default is parameter.empty and name not in asked and name != "callback":
                raise InputTypeError(f"{do} has no {name!r}; it must be there")
        return method(**asked, **({"callback": callback} if "callback" in parameters else {}))

    def column(self, pixel: Any, channel: Any = None) -> Reply:
        """What one projector pixel lights."""
        return {}, {"picture": self.T @ self._unit("pixel", pixel, channel, self.T.grid)}

    def row(self, pixel: Any, channel: Any = None) -> Reply:
        """How much each projector pixel adds to one camera pixel."""
        T = self.T
        unit = self._unit("pixel", pixel, channel, T.camera_grid)
        columns, shape = layout.unpack("pixel", unit, T.camera_grid, T.channels)
        columns = [np.concatenate(columns)] if T.couples else columns
        rows = [A.T.matmat(x) for A, x in zip(T.operators, columns, strict=True)]
        return {}, {"pattern": shape.pack(rows, T.grid)}

    def relight(self, pattern: Any = None, picture: Any = None) -> Reply:
        """The picture under a pattern, linear light or sRGB codes, which the projector shows from now on; or now."""
        if pattern is not None and picture is not None:
            raise InputError("relight has both pattern and picture; it must have at most one of them")
        if pattern is not None:
            light = to_linear(checks.shape("pattern", pattern, self.T.grid, (*self.T.grid, 3)), "auto")
        else:
            light = self.pattern if picture is None else self._picture(picture)[2]
        seen = {"picture": self.T @ light}
        if light is not self.pattern:
            self.pattern, self.white = light, 1.0
        return {}, seen if pattern is not None else seen | {"pattern": light}

    def bounces(self, callback: Callback, of: Any = "pattern", picture: Any = None, count: Any = 4) -> Reply:
        """Direct light and bounces of a picture, or of what the current pattern looks like."""
        checks.one_of("of", of, ("pattern", "picture"))
        checks.count("count", count, least=0, most=_BOUNCES)
        image = self.T @ self.pattern if of == "pattern" else self._picture(picture)[1]
        result = separate(self.T, image, count, callback=callback)
        numbered = {f"bounce_{k}": bounce for k, bounce in enumerate(result.bounces, 1)}
        light = {"direct": result.direct, **numbered, "rest": result.rest}
        whole = float(np.sum(image, dtype=np.float64)) or 1.0
        shares = [float(np.sum(part, dtype=np.float64)) / whole for part in light.values()]
        if self._shows_noise():
            std = zip(["direct", *numbered], [result.std.direct, *result.std.bounces], strict=True)
            light |= {f"{name}_std": deviation for name, deviation in std}
        return {"shares": shares, "warning": result.warning}, light

    def compensate(
        self, callback: Callback, picture: Any, gain: Any = None, bounds: Any = (0, 1), method: Any = "auto"
    ) -> Reply:
        """The pattern under which the scene looks like a picture; the projector shows it from now on."""
        name, desired, shown = self._picture(picture)
        gain = ("auto" if self.setup else 1.0) if gain is None else gain
        settings = {"gain": gain, "bounds": bounds, "method": method}
        ambient, start = self.setup and self.setup.ambient, time.perf_counter()
        c = compensate(self.T, desired, background=ambient, callback=callback, **settings)
        solves = report.solution(c.solution)
        solves += [each for each in report.solution(c.limited) if each not in solves]
        facts = {key: getattr(c, key) for key in ("error", "gain", "clipped", "gap", "transport_error")}
        facts["method"] = ", ".join(dict.fromkeys(solve["method"] for solve in solves))
        facts["products"] = sum(solve["products"] for solve in solves)
        facts["residuals"] = max((solve["residuals"] for solve in solves), key=lambda r: (len(r), r[-1:]))
        facts["seconds"] = time.perf_counter() - start
        self.pattern, self.white = c.pattern, max(float(bounds[1]), 0.0) or 1.0
        self._compensation = c, {"picture": name, **settings, **facts, "solves": solves}
        names = ("pattern", "appearance", "target", "out_of_reach")
        plain = self.T @ shown  # what the picture itself makes as a pattern, as bright as the target
        plain *= np.float32(c.target.mean() / max(plain.mean(), np.finfo(np.float32).tiny))
        return facts, {name: getattr(c, name) for name in names} | {"uncompensated": plain}

    def pictures(self) -> Reply:
        """Names and numbers of the pictures that there are."""
        return {"pictures": [{"picture": k, "name": name} for k, (name, *_) in self._pictures.items()]}, {}

    def projector(self) -> Reply:
        """A window that shows the pattern, which the server sends."""
        return {}, {}

    def add(self, name: str, picture: np.ndarray) -> int:
        """Keep a picture, on the grids of camera and projector; its number."""
        self._last += 1
        grids = dict.fromkeys((self.T.camera_grid, self.T.grid))
        sizes = [picture if picture.shape[:2] == grid else images.resize(picture, grid) for grid in grids]
        self._pictures[self._last] = name, sizes[0], sizes[-1]
        for number in [k for k in self._pictures if k > self._named][:-_UPLOADS]:
            del self._pictures[number]
        return self._last

    def upload(self, name: str, content: bytes | bytearray) -> dict[str, Any]:
        """Keep the picture of a file; InputError before decoding where that has too many pixels."""
        suffix = Path(name).suffix.lower()
        if suffix not in BITS:
            raise InputError(f"{name!r} has another extension than {', '.join(BITS)}")
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"picture{suffix}"
            path.write_bytes(content)
            try:
                _check_pixels(path)
                picture = images.read(path)
            except LtclError as error:
                raise InputError(str(error).replace(str(path), repr(name))) from None
        channels = picture.shape[2:] or (1,)
        return {"picture": self.add(name, picture), "name": name, "shape": [*picture.shape[:2], *channels]}

    def result(self, name: str) -> bytes | None:
        """A file of the last compensation; None where there is none."""
        if self._compensation is None or name not in (*RESULTS, "report.json"):
            return None
        c, facts = self._compensation
        if name == "report.json":
            known = {
                "title": self.title,
                "versions": report.versions(),
                "device": report.device(self.T.device),
            }
            return report.dumps(known | facts).encode()
        white, encoding = max(float(facts["bounds"][1]), 0.0) or 1.0, "auto"
        if name == "codes.png":
            what, encoding = self._codes(c.pattern, white) / np.float32(255), "linear"
        else:
            what = c.pattern / np.float32(white) if name == "pattern.png" else getattr(c, name[:-4])
        with TemporaryDirectory() as folder:
            images.write(path := Path(folder) / name, what, encoding=encoding)
            return path.read_bytes()

    def codes(self) -> np.ndarray:
        """What a projector shows now, uint8 on its pixels."""
        return self._codes(self.pattern, self.white)

    def _codes(self, pattern: np.ndarray, white: float) -> np.ndarray:
        if self.setup is None:
            return from_linear(pattern / np.float32(white), "srgb", 8, is_float=False)
        return from_linear(self.setup.codes(pattern), "linear", 8, is_float=False)

    def _shows_noise(self) -> bool:
        T = self.T
        entries = all(isinstance(matrix, ENTRIES) for matrix in T.matrices)
        return T.is_square and (entries or T.measured_noise is not None)

    def _picture(self, number: Any) -> tuple[str, np.ndarray, np.ndarray]:
        if not isinstance(number, int) or number not in self._pictures:
            known = ", ".join(map(str, self._pictures)) or "none yet"
            raise InputError(f"picture is {checks.shown(number)}; it must be the number of one: {known}")
        return self._pictures[number]

    def _unit(self, name: str, pixel: Any, channel: Any, grid: tuple[int, int]) -> np.ndarray:
        if not isinstance(pixel, list) or len(pixel) != 2:
            raise InputError(f"{name} is {checks.shown(pixel)}; it must be [row, column]")
        row, column = (
            checks.count(f"{name}[{k}]", n, least=0, most=size - 1)
            for k, (n, size) in enumerate(zip(pixel, grid, strict=True))
        )
        if channel is None:
            unit = np.zeros(grid, np.float32)
            unit[row, column] = 1.0
            return unit
        unit = np.zeros((*grid, 3), np.float32)
        unit[row, column, checks.count("channel", channel, least=0, most=self.T.channels - 1)] = 1.0
        return unit if self.T.channels == 3 else unit[..., 0]


def _check_pixels(path: Path) -> None:
    """Refuse a file by the size that its header tells, before anything is decoded."""
    with decoding(path):
        if path.suffix == ".exr":
            low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
            w, h = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        else:
            w, h = Image.open(path, formats=("PNG", "JPEG", "BMP", "TIFF")).size
        if not 0 < w * h <= LARGEST_PICTURE:
            raise FileError(f"has {h} x {w} pixels; it must have at most {LARGEST_PICTURE}")
