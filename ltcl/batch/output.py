# SPDX-License-Identifier: BSD-3-Clause
"""Where patterns go: numbered pictures, each there whole or not at all, and a video of them at the end."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltcl import images

BITS = {"png": 16, "exr": 32}
_LEFT = re.compile(r"\.(pattern|appearance)_\d{6,}-[0-9a-f]{12}\.(png|exr)|\.frames-[0-9a-f]{12}\.json")


@dataclass(frozen=True)
class Output:
    """Files of a run in `folder`; the .png are sRGB, in which `white` light is white.

    Patterns are what `codes` makes of light, where that is given.
    """

    folder: Path
    kind: str
    white: float
    appearance: bool
    codes: Callable[[np.ndarray], np.ndarray] | None = None

    def files(self, number: int) -> list[Path]:
        """Those of a frame: its pattern and, where wanted, what will be seen."""
        seen = [self.folder / "appearance" / f"appearance_{number:06}.{self.kind}"] * self.appearance
        return [self.folder / f"pattern_{number:06}.{self.kind}", *seen]

    def write(self, number: int, pattern: np.ndarray, appearance: np.ndarray, gain: float) -> None:
        """A frame's files; in a .png what will be seen is shown over the gain, as the picture asked for."""
        exact = self.kind == "exr"
        for file, picture, scale in zip(
            self.files(number), (pattern, appearance), (self.white, gain), strict=False
        ):
            if self.codes is not None and picture is pattern and not exact:
                images.write(file, self.codes(pattern), bits=BITS[self.kind], encoding="linear")
                continue
            images.write(file, picture if exact else picture / np.float32(scale), bits=BITS[self.kind])

    def patterns(self, numbers: list[int]) -> Iterator[np.ndarray]:
        """The patterns as they were written, white at 1; their codes as what sRGB makes the same codes of."""
        if self.codes is not None and self.kind == "exr":
            feed = self.codes
            return (images.from_srgb(feed(images.read(self.files(number)[0]))) for number in numbers)
        scale = np.float32(self.white if self.kind == "exr" else 1.0)
        return (images.read(self.files(number)[0]) / scale for number in numbers)

    def sweep(self) -> None:
        """Take away what a killed run has left half written."""
        for folder in (self.folder, self.folder / "appearance"):
            for file in folder.glob(".*") if folder.is_dir() else ():
                if _LEFT.fullmatch(file.name):
                    file.unlink(missing_ok=True)
