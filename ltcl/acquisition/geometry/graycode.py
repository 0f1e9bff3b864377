# SPDX-License-Identifier: BSD-3-Clause
"""Gray code: patterns, and the projector coordinates that their photographs give.

Neighbouring columns differ in one bit, so a pixel on the edge of a stripe has one undecided bit
only, and its coordinate lies between two neighbours. The patterns are those of OpenCV's
structured_light, in its order: column bits, highest first, each followed by its inverse; then row
bits; then white and black. `bits` decides what photographs of them show. To spare photographs,
inverses of coarse bits may be left out: white tells them from black, and few edges are theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.axis import Axis
from ltcl.acquisition.geometry.bits import BRIGHTEST_QUANTILE, BitLayout, StripDecoder
from ltcl.acquisition.geometry.photographs import PhotographFile, PhotographList, Photographs
from ltcl.acquisition.radiometry.strips import in_strips
from ltcl.errors import InputError

# Values of all pictures of a strip of rows: 2 MiB of float32 stay in the cache.
STRIP_VALUES = 1 << 19

# Rows of a strip, at least: one more is read for the edges below.
MIN_STRIP_ROWS = 4

# Least difference that counts, as a part of the brightest pixel.
MIN_CONTRAST = 2e-3

# Least difference that counts, in codes of the camera.
MIN_CODES = 1.5

# Rows of a photograph that determine it.
MAX_SAMPLED_ROWS = 512

# Finest bits of each axis that are followed by their inverses where photographs are spared.
FEW_INVERSES = 3


@dataclass(frozen=True)
class GrayCode:
    """Gray code patterns for a projector grid, and the decoding of their photographs.

    Parameters
    ----------
    grid : (int, int)
        Height and width of the projector.
    has_few_inverses : bool
        Inverses of the three finest bits of each axis alone.

    Raises
    ------
    InputError
        The grid is not two positive integers.

    Examples
    --------
    >>> code = GrayCode((3, 5))
    >>> len(code.patterns()), code.patterns()[4][0].tolist()
    (12, [0.0, 1.0, 1.0, 0.0, 0.0])
    >>> x, y = code.decode(code.patterns())
    >>> x.value[0].tolist(), y.value[:, 0].tolist()
    ([0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 2.0])
    """

    grid: tuple[int, int]
    has_few_inverses: bool = False

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)
        checks.flag("has_few_inverses", self.has_few_inverses)

    @property
    def bits(self) -> tuple[int, int]:
        """Number of bits of a column and of a row; a side of 1 has none."""
        h, w = self.grid
        return (w - 1).bit_length(), (h - 1).bit_length()

    @property
    def count(self) -> int:
        """Number of patterns."""
        return self.layout.count

    @property
    def layout(self) -> BitLayout:
        """Places of the bits among the patterns."""
        return BitLayout(self.bits, FEW_INVERSES if self.has_few_inverses else max(self.bits))

    def layout_of(self, count: int) -> BitLayout:
        """Places of the bits among so many photographs, with all, few or no inverses."""
        allowed = []
        for inverses in (max(self.bits), FEW_INVERSES, 0):
            layout = BitLayout(self.bits, inverses)
            if layout.count == count:
                return layout
            allowed.append(layout.count)
        every, few, none = allowed
        raise InputError(
            f"photographs are {count}; they must be {every}, one for each pattern, "
            f"{few} with inverses of fine bits alone, or {none} without the inverses"
        )

    def patterns(self) -> list[np.ndarray]:
        """Patterns as codes (h, w) in {0, 1}, float32, which are not to be written to."""
        h, w = self.grid
        column_bits, row_bits = self.bits
        codes = [bit[None, :] for bit in _gray_bits(w, column_bits)]
        codes += [bit[:, None] for bit in _gray_bits(h, row_bits)]
        patterns = []
        for bit, has_inverse in zip(codes, self.layout.has_inverse, strict=True):
            code = bit.astype(np.float32)
            patterns.append(np.broadcast_to(code, self.grid))
            if has_inverse:
                patterns.append(np.broadcast_to(1.0 - code, self.grid))
        patterns.append(np.ones(self.grid, np.float32))
        patterns.append(np.zeros(self.grid, np.float32))
        return patterns

    def decode(
        self,
        images: Sequence[Any] | PhotographFile,
        *,
        levels: int | None = None,
        edges: bool = True,
    ) -> tuple[Axis, Axis]:
        """Decode photographs into the projector coordinates x and y of every camera pixel.

        Parameters
        ----------
        images : sequence of (H, W) or (H, W, 3) arrays
            Photographs of `patterns()`, in that order, or of these with few or without inverses, as
            in `ltcl.acquisition.geometry.decode`.
        levels : int, optional
            Number of codes of the camera if images are floats.
        edges : bool
            Also find where stripes end between pixels.

        Returns
        -------
        x, y : Axis

        Raises
        ------
        InputError
            As in `ltcl.acquisition.geometry.decode`.
        """
        count = len(images)
        layout = self.layout_of(count)
        pictures: Photographs
        if isinstance(images, PhotographFile):
            pictures = images
        else:
            pictures = PhotographList(images)
        min_difference = _min_difference(pictures, levels)
        decoder = StripDecoder(self.grid, layout, pictures, min_difference, edges)
        H, W = pictures.shape
        in_strips(H, max(STRIP_VALUES // (W * count), MIN_STRIP_ROWS), decoder.decode)
        return decoder.x, decoder.y


def _gray_bits(size: int, bits: int) -> list[np.ndarray]:
    """Bits of the Gray code of the numbers below `size`, highest first."""
    number = np.arange(size)
    gray = number ^ (number >> 1)
    return [(gray >> k) & 1 for k in reversed(range(bits))]


def _min_difference(pictures: Photographs, levels: int | None) -> float:
    """Least difference of two photographs that counts; white as dark as black is refused."""
    contrast = MIN_CONTRAST
    if levels is not None:
        largest_code = checks.count("levels", levels, least=2) - 1
        contrast = max(contrast, MIN_CODES / largest_code)
    H, _ = pictures.shape
    rows = slice(0, H, max(H // MAX_SAMPLED_ROWS, 1))
    lit = pictures.read(-2, rows) - pictures.read(-1, rows)
    brightest = float(np.quantile(lit, BRIGHTEST_QUANTILE))
    if brightest <= 0.0:
        white_name = f"photographs[{pictures.count - 2}]"
        black_name = f"photographs[{pictures.count - 1}]"
        raise InputError(
            f"{white_name} is of the white pattern and must be brighter than {black_name}, of the "
            f"black one; the difference is at most {brightest:.3g}"
        )
    return max(contrast * brightest, pictures.code_step)
