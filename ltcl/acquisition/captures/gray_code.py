# SPDX-License-Identifier: BSD-3-Clause
"""`import_gray_code`: the map and the direct light of photographs that other programs took.

Fine stripes light half of everything evenly, so that a pixel shows `l_d + l_g / 2` when its own
stripe is on and `l_g / 2` when it is off (Nayar et al. 2006). So the direct light l_d is the
difference d_b of the light under stripes b and their inverse. Where a pixel lies on an edge d_b is
smaller: of the finest stripes the mean counts with the weights d_b^2,

    l_d = sum_b |d_b|^3 / sum_b d_b^2.

Known limit: one exposure. What is saturated in it has less direct light than it should.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltcl import checks
from ltcl.acquisition.captures.order import AxisCode, PhotographOrder
from ltcl.acquisition.geometry import Correspondence, Resampling, decode
from ltcl.acquisition.geometry.bits import FINE_BITS
from ltcl.acquisition.geometry.photographs import PhotographFile
from ltcl.acquisition.rigs.photographs import RAW_SUFFIXES, read_photograph
from ltcl.errors import InputError
from ltcl.files import as_path
from ltcl.images.encoding import ENCODINGS, Encoding, to_linear

# Share of full scale from which a pixel is saturated.
SATURATION_LEVEL = 0.999
# Share of decoded camera pixels that may lie beyond the projector, by errors of single bits.
MAX_BEYOND = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class Capture:
    """The map and the light that photographs of Gray code tell.

    Attributes
    ----------
    mapping : Correspondence
        From the camera's pixels to those of the projector.
    direct : ndarray or None
        Direct light of each projector pixel, (h, w[, 3]) float32, in the units of the photographs
        with 1 at full scale; 0 where no camera pixel shows it. None without a photograph of white.
    seen : float
        Share of the projector's pixels that the camera sees.
    saturated : float
        Share of the lit camera pixels that are saturated under white.
    indirect : float
        Light of white that is not direct, relative to it, at the median pixel; NaN without white.
    photographs : int
    """

    mapping: Correspondence
    direct: np.ndarray | None
    seen: float
    saturated: float
    indirect: float
    photographs: int


def import_gray_code(
    folder: str | os.PathLike[str],
    grid: tuple[int, int],
    order: str | os.PathLike[str] | PhotographOrder = "opencv",
    *,
    encoding: Encoding = "auto",
) -> Capture:
    """Read photographs of Gray code that another program took.

    Parameters
    ----------
    folder : path
        Folder with the photographs, all of one exposure.
    grid : (int, int)
        Height and width of the projector.
    order : "opencv", "scan3d", path or PhotographOrder
        Which file shows which pattern: as OpenCV's structured_light has them, followed by white and
        black; as Moreno and Taubin's scan3d-capture has them; or as a TOML file says.
    encoding : "auto", "srgb" or "linear"
        Encoding of the photographs, as in `ltcl.images.read`; camera RAW is linear.

    Returns
    -------
    Capture

    Raises
    ------
    FileError, AcquisitionError
        A photograph is missing, or cannot be read.
    InputError
        The order is not valid, photographs have different sizes, white is as dark as black, no
        pixel is decoded, or more than a tenth of the decoded pixels lie beyond the grid.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from pathlib import Path
    >>> from ltcl.acquisition.geometry import GrayCode
    >>> folder = Path(tempfile.mkdtemp())
    >>> for number, pattern in enumerate(GrayCode((8, 16)).patterns()):
    ...     ltcl.images.write(folder / f"{number}.png", 0.5 * pattern)
    >>> capture = import_gray_code(folder, (8, 16))
    >>> capture.mapping.decoded, float(capture.direct.max().round(2))
    (1.0, 0.5)
    """
    folder = as_path(folder, "folder")
    height, width = checks.grid("grid", grid)
    grid = (height, width)
    checks.one_of("encoding", encoding, ENCODINGS)
    if not isinstance(order, PhotographOrder):
        order = PhotographOrder.read(order)
    files = order.files(folder, grid)
    reader = _Reader(files, encoding, order.has_inverses)
    codes = order.codes(grid)
    photographs = reader.read_all()
    # All numbers that the stripes can tell, so that those beyond the projector are seen.
    cells = (_code_length(codes[1]), _code_length(codes[0]))
    decoded = decode(photographs, cells, levels=reader.levels)
    mapping = _on_pixels(decoded, codes, grid)
    beyond = 1.0 - np.count_nonzero(mapping.valid) / max(np.count_nonzero(decoded.valid), 1)
    if beyond > MAX_BEYOND:
        raise InputError(
            f"{folder}: {beyond:.0%} of decoded pixels lie beyond {height} x {width}; grid must be "
            "that of the projector, height first, and order that of the photographs"
        )
    resampling = Resampling.of(mapping)
    direct = None
    saturated = 0.0
    indirect = float("nan")
    if "white" in files:
        light = reader.direct
        direct = resampling.apply(light)
        valid = mapping.valid
        saturated = float(reader.is_saturated[valid].mean())
        white = reader.white[valid]
        share = 1.0 - light[valid] / np.maximum(white, np.finfo(np.float32).tiny)
        indirect = float(np.median(share))
    return Capture(
        mapping=mapping,
        direct=direct,
        seen=float(resampling.seen.mean()),
        saturated=saturated,
        indirect=indirect,
        photographs=sum(map(len, files.values())),
    )


class _Reader:
    """Reads photographs, of which light under the finest stripes stays in memory."""

    def __init__(
        self, files: dict[str, list[Path]], encoding: Encoding, has_inverses: bool
    ) -> None:
        self._files = files
        self._encoding: Encoding = encoding
        self._has_inverses = has_inverses
        self._shape: tuple[int, ...] = ()
        # Number of codes of the camera; None for floats.
        self.levels: int | None = None
        # Light of white less black, in all channels, and where it is saturated.
        self.white = np.zeros(0)
        self.is_saturated = np.zeros(0, bool)
        # Sums of |d_b|^3 and d_b^2 over the finest stripes.
        self._cubes = np.zeros(0)
        self._squares = np.zeros(0)

    @property
    def direct(self) -> np.ndarray:
        """Direct light of the camera's pixels, (H, W[, 3])."""
        return self._cubes / np.maximum(self._squares, np.finfo(np.float32).tiny)

    def read_all(self) -> PhotographFile:
        """Read all photographs, in the order of `GrayCode`, with white and black at the end."""
        black = None
        if "black" in self._files:
            black = self._read("black", self._files["black"][0])
        first = self._read("columns", self._first_stripes())
        if black is None:
            black = np.zeros_like(first)
        self._read_white(black, first)
        self._cubes = np.zeros(first.shape, np.float32)
        self._squares = np.zeros(first.shape, np.float32)
        photographs = PhotographFile()
        for axis in ("columns", "rows"):
            self._append_axis(photographs, axis, black)
        photographs.append(self.white + black)
        photographs.append(black)
        return photographs

    def _first_stripes(self) -> Path:
        for axis in ("columns", "rows"):
            if self._files[axis]:
                return self._files[axis][0]
        raise InputError("grid is 1 x 1; it must have several pixels")

    def _read_white(self, black: np.ndarray, stripes: np.ndarray) -> None:
        if "white" in self._files:
            light = self._read("white", self._files["white"][0])
            full = light.reshape(*light.shape[:2], -1).max(axis=-1)
            self.is_saturated = full >= SATURATION_LEVEL
        else:
            # Stripes and their inverse together are white, with black once more.
            axis = "columns" if self._files["columns"] else "rows"
            inverse = self._read("the inverse", self._files[f"{axis}_inverse"][0])
            light = stripes + inverse - black
        self.white = light - black

    def _append_axis(self, photographs: PhotographFile, axis: str, black: np.ndarray) -> None:
        paths = self._files[axis]
        for number, path in enumerate(paths):
            stripes = self._read(f"{axis} {number}", path)
            photographs.append(stripes)
            if self._has_inverses:
                name = f"{axis}_inverse"
                inverse = self._read(f"{name} {number}", self._files[name][number])
                photographs.append(inverse)
            else:
                inverse = self.white + 2.0 * black - stripes
            if number >= len(paths) - FINE_BITS:
                difference = np.abs(stripes - inverse)
                self._squares += difference**2
                self._cubes += difference**3

    def _read(self, name: str, path: Path) -> np.ndarray:
        """Linear light of a photograph, in [0, 1] of full scale."""
        codes = read_photograph(f"{name}, {path.name},", path, 3, None)
        if not self._shape:
            self._shape = codes.shape
        if codes.shape != self._shape:
            raise InputError(
                f"{path}: has shape {codes.shape}; it must be {self._shape}, as the first one"
            )
        if codes.dtype.kind == "u":
            self.levels = np.iinfo(codes.dtype).max + 1
        encoding = self._encoding
        if path.suffix.lower() in RAW_SUFFIXES:
            encoding = "linear"
        return to_linear(codes, encoding)


def _code_length(code: AxisCode) -> int:
    """The numbers that the bits of a code can tell."""
    return 1 << (code.cells - 1).bit_length()


def _on_pixels(
    mapping: Correspondence, codes: tuple[AxisCode, AxisCode], grid: tuple[int, int]
) -> Correspondence:
    """The map to the pixels of the projector, of one to the cells of its code."""
    height, width = grid
    coordinates = []
    valid = mapping.valid
    for values, code, side in zip((mapping.x, mapping.y), codes, (width, height), strict=True):
        # The centre of a cell is that of its pixels.
        pixels = (values + 0.5) * code.cell - 0.5 - code.offset
        coordinates.append(pixels)
        with np.errstate(invalid="ignore"):
            valid = valid & (pixels >= -0.5) & (pixels <= side - 0.5)
    return Correspondence(coordinates[0], coordinates[1], valid, grid)
