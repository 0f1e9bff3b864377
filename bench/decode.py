# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code into a map, beside OpenCV's structured_light, in megapixels a second.

42 photographs, 1280 x 1024, 8 bits, of a projector of 1024 x 768 that lights a plane askance, with
noise. OpenCV decodes pairs of cameras (`GrayCodePattern.decode`), two copies of ours here, and both
pictures count; its own next step, a disparity for each projector pixel, is in that time and cannot
be left out. Ours decides every bit by direct and indirect light, drops what neighbours do not
confirm and, in the second row, finds fractions of a pixel: the facts tell what comes of that.
"""

from __future__ import annotations

import cv2
import numpy as np

from _harness import Row, parse_options, report, seconds
from ltcl.acquisition.geometry import GrayCode, Resampling, decode

QUESTIONS = {
    "bits": ("bits and coordinates", None),
    "whole": ("and neighbours compared", 2.0),
    "fraction": ("and fractions of a pixel", 1.0),
}


def photographs(code: GrayCode, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """Bilinear samples of the patterns, 8 bits, with a standard deviation of 2 of 255."""
    rng, maps = np.random.default_rng(1), (x.astype(np.float32), y.astype(np.float32))
    images = []
    for pattern in code.patterns():
        light = cv2.remap(pattern, *maps, cv2.INTER_LINEAR)
        noise = 2.0 * rng.standard_normal(x.shape, dtype=np.float32)
        images.append(np.clip(12 + 160 * light + noise, 0, 255).astype(np.uint8))
    return images


def off(x: np.ndarray, y: np.ndarray, truth: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square distance from the truth, of what was decoded."""
    return float(np.sqrt(np.nanmean((x - truth[0]) ** 2 + (y - truth[1]) ** 2)))


def main() -> None:
    given = parse_options(__doc__ or "")
    grid, (H, W) = ((48, 64), (60, 80)) if given.smoke else ((768, 1024), (1024, 1280))
    (h, w), code = grid, GrayCode(grid)
    v, u = np.mgrid[:H, :W] / np.array([H, W]).reshape(2, 1, 1)
    d = 1 + 0.08 * u + 0.05 * v
    # Projector coordinates that each camera pixel sees.
    truth = w * (0.05 + 0.8 * u + 0.06 * v) / d, h * (0.04 + 0.85 * v + 0.05 * u) / d
    images = photographs(code, *truth)
    *coded, white, black = images
    peer = cv2.structured_light.GrayCodePattern.create(grid[1], grid[0])
    peer.setBlackThreshold(10)
    peer.setWhiteThreshold(5)
    actions = {
        "opencv": lambda: peer.decode([coded, coded], None, [black, black], [white, white])[0],
        "bits": lambda: code.decode(images, edges=False),
        "whole": lambda: decode(images, grid, subpixel=False),
        "fraction": lambda: decode(images, grid),
    }
    if not actions["opencv"]():
        raise SystemExit("OpenCV decoded nothing")
    rate = {name: H * W / spent / 1e6 for name, spent in seconds(actions, 3).items()}
    rows, theirs = [], 2 * rate["opencv"]
    for name, (question, target) in QUESTIONS.items():
        ours = rate[name]
        row = Row(
            question, "cv2 GrayCodePattern.decode", theirs, ours, "Mpixel/s", ours / theirs, target
        )
        rows.append(row)
    some = slice(H // 2, H // 2 + 2)  # rows in which OpenCV is asked pixel by pixel
    answers = [
        peer.getProjPixel(coded, i, j) for j in range(some.start, some.stop) for i in range(W)
    ]
    places = np.array([(np.nan, np.nan) if bad else place for bad, place in answers]).reshape(
        -1, W, 2
    )
    x, y = np.moveaxis(places, -1, 0)
    found, whole = decode(images, grid), decode(images, grid, subpixel=False)
    facts = {
        "decoded, ours": found.decoded,
        f"decoded, opencv, {2 * W} pixels": float(np.mean(np.isfinite(x))),
        "rms, opencv there": off(x, y, (truth[0][some], truth[1][some])),
        "rms, whole numbers": off(whole.x, whole.y, truth),
        "rms, fractions": off(found.x, found.y, truth),
        "nonzeros of the resampling, millions": Resampling.of(found).weights.nnz / 1e6,
    }
    report(given, "Gray code into a map", rows, facts)


if __name__ == "__main__":
    main()
