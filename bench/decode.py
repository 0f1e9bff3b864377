# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code into a map, beside OpenCV's structured_light, in megapixels a second.

42 photographs, 1280 x 1024, 8 bits, of a projector of 1024 x 768 that lights a plane askance, with noise.
OpenCV decodes pairs of cameras (`GrayCodePattern.decode`), two copies of ours here, and both pictures
count; its own next step, a disparity for each projector pixel, is in that time and cannot be left out. Ours
decides every bit by direct and indirect light, drops what neighbours do not confirm and, in the second row,
finds fractions of a pixel: the facts tell what comes of that.
"""

from __future__ import annotations

import cv2
import numpy as np

from _harness import Row, options, report, seconds
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, decode

QUESTIONS = {
    "bits": ("bits and coordinates", None),
    "whole": ("and neighbours compared", 2.0),
    "fraction": ("and fractions of a pixel", 1.0),
}


def scene(grid: tuple[int, int], camera: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Projector coordinates that each camera pixel sees."""
    (h, w), (H, W) = grid, camera
    v, u = np.mgrid[:H, :W] / np.array([H, W]).reshape(2, 1, 1)
    d = 1 + 0.08 * u + 0.05 * v
    return w * (0.05 + 0.8 * u + 0.06 * v) / d, h * (0.04 + 0.85 * v + 0.05 * u) / d


def photographs(code: GrayCode, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """Bilinear samples of the patterns, 8 bits, with a standard deviation of 2 of 255."""
    rng, maps = np.random.default_rng(1), (x.astype(np.float32), y.astype(np.float32))
    images = []
    for pattern in code.patterns():
        light = cv2.remap(pattern, *maps, cv2.INTER_LINEAR)
        noise = 2.0 * rng.standard_normal(x.shape, dtype=np.float32)
        images.append(np.clip(12 + 160 * light + noise, 0, 255).astype(np.uint8))
    return images


class Peer:
    """OpenCV on two cameras that take the same photographs."""

    def __init__(self, code: GrayCode, images: list[np.ndarray]) -> None:
        self.pattern = cv2.structured_light.GrayCodePattern.create(code.grid[1], code.grid[0])
        self.pattern.setBlackThreshold(10)
        self.pattern.setWhiteThreshold(5)
        self.images = images

    def __call__(self) -> bool:
        """Decode both; whether it did."""
        *coded, white, black = self.images
        return self.pattern.decode([coded, coded], None, [black, black], [white, white])[0]

    def map(self, rows: slice) -> np.ndarray:
        """(rows, W, 2) of a few rows, pixel by pixel; NaN where it gives none."""
        W = self.images[0].shape[1]
        places = [(u, v) for v in range(rows.start, rows.stop) for u in range(W)]
        found = [self.pattern.getProjPixel(self.images[:-2], u, v) for u, v in places]
        return np.array([(np.nan, np.nan) if bad else p for bad, p in found]).reshape(-1, W, 2)


def off(x: np.ndarray, y: np.ndarray, truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square distance from the truth, of what was decoded."""
    return float(np.sqrt(np.nanmean((x - truth[0]) ** 2 + (y - truth[1]) ** 2)))


def facts(found: Correspondence, whole: Correspondence, peer: Peer, truth: tuple[np.ndarray, ...]) -> dict:
    """How good the maps are: decoded, and off by how many projector pixels."""
    rows = slice(len(truth[0]) // 2, len(truth[0]) // 2 + 2)
    theirs = peer.map(rows)
    return {
        "decoded, ours": found.decoded,
        f"decoded, opencv, {2 * theirs.shape[1]} pixels": float(np.mean(np.isfinite(theirs[..., 0]))),
        "rms, opencv there": off(theirs[..., 0], theirs[..., 1], (truth[0][rows], truth[1][rows])),
        "rms, whole numbers": off(whole.x, whole.y, (truth[0], truth[1])),
        "rms, fractions": off(found.x, found.y, (truth[0], truth[1])),
        "nonzeros of the resampling, millions": Resampling.of(found).weights.nnz / 1e6,
    }


def main() -> None:
    given = options(__doc__ or "")
    grid, camera = ((48, 64), (60, 80)) if given.smoke else ((768, 1024), (1024, 1280))
    truth = scene(grid, camera)
    code = GrayCode(grid)
    images = photographs(code, *truth)
    peer = Peer(code, images)
    if not peer():
        raise SystemExit("OpenCV decoded nothing")
    actions = {
        "opencv": peer,
        "bits": lambda: code.decode(images, edges=False),
        "whole": lambda: decode(images, grid, subpixel=False),
        "fraction": lambda: decode(images, grid),
    }
    rate = {name: camera[0] * camera[1] / spent / 1e6 for name, spent in seconds(actions, 3).items()}
    rows, theirs = [], 2 * rate["opencv"]
    for name, (question, target) in QUESTIONS.items():
        ours = rate[name]
        row = Row(question, "cv2 GrayCodePattern.decode", theirs, ours, "Mpixel/s", ours / theirs, target)
        rows.append(row)
    found, whole = decode(images, grid), decode(images, grid, subpixel=False)
    report(given, "Gray code into a map", rows, facts(found, whole, peer, truth))


if __name__ == "__main__":
    main()
