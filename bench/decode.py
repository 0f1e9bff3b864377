# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of Gray code into a map, beside OpenCV's structured_light, in megapixels a second.

42 photographs, 1280 x 1024, 8 bits, of a projector of 1024 x 768 that lights a plane askance, with
noise. OpenCV decodes pairs of cameras (`GrayCodePattern.decode`), two copies of ours here, and both
pictures count; its own next step, a disparity for each projector pixel, is in that time and cannot
be left out. Ours decides every bit by direct and indirect light, drops decoded places that their
neighbours do not confirm and, in the second row, finds fractions of a pixel. The facts compare the
coverage and accuracy of both.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from _harness import Row, parse_options, report, seconds
from ltcl.acquisition.geometry import GrayCode, Resampling, decode

# Question and target of each of our ways.
QUESTIONS = {
    "bits": ("bits and coordinates", None),
    "whole": ("and neighbours compared", 2.0),
    "fraction": ("and fractions of a pixel", 1.0),
}

Coordinates = tuple[np.ndarray, np.ndarray]


def photographs(code: GrayCode, x: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
    """Bilinear samples of the patterns, 8 bits, with a standard deviation of 2 of 255."""
    rng = np.random.default_rng(1)
    map_x = x.astype(np.float32)
    map_y = y.astype(np.float32)
    images = []
    for pattern in code.patterns():
        light = cv2.remap(pattern, map_x, map_y, cv2.INTER_LINEAR)
        noise = 2.0 * rng.standard_normal(x.shape, dtype=np.float32)
        images.append(np.clip(12 + 160 * light + noise, 0, 255).astype(np.uint8))
    return images


def plane(grid: tuple[int, int], camera_grid: tuple[int, int]) -> Coordinates:
    """Projector coordinates x and y that each camera pixel sees."""
    h, w = grid
    H, W = camera_grid
    v, u = np.mgrid[:H, :W] / np.array([H, W]).reshape(2, 1, 1)
    d = 1 + 0.08 * u + 0.05 * v
    x = w * (0.05 + 0.8 * u + 0.06 * v) / d
    y = h * (0.04 + 0.85 * v + 0.05 * u) / d
    return x, y


def rms_distance(x: np.ndarray, y: np.ndarray, truth: Coordinates) -> float:
    """Root mean square distance of decoded places from the truth."""
    true_x, true_y = truth
    return float(np.sqrt(np.nanmean((x - true_x) ** 2 + (y - true_y) ** 2)))


def decode_by_pixels(peer: Any, coded: list[np.ndarray], rows: slice) -> np.ndarray:
    """OpenCV's projector coordinates, asked pixel by pixel: (rows, W, 2), NaN where it has none."""
    width = coded[0].shape[1]
    places = []
    for j in range(rows.start, rows.stop):
        for i in range(width):
            has_failed, place = peer.getProjPixel(coded, i, j)
            places.append((np.nan, np.nan) if has_failed else place)
    return np.array(places).reshape(-1, width, 2)


def comparisons(rate: dict[str, float]) -> list[Row]:
    """Compare megapixels a second; OpenCV decodes two pictures at once."""
    theirs = 2 * rate["opencv"]
    rows = []
    for name, (question, target) in QUESTIONS.items():
        row = Row(
            question=question,
            competitor="cv2 GrayCodePattern.decode",
            theirs=theirs,
            ours=rate[name],
            unit="Mpixel/s",
            ratio=rate[name] / theirs,
            target=target,
        )
        rows.append(row)
    return rows


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    grid = (768, 1024)
    camera_grid = (1024, 1280)
    if options.smoke:
        grid = (48, 64)
        camera_grid = (60, 80)
    H, W = camera_grid
    code = GrayCode(grid)
    truth = plane(grid, camera_grid)
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
    # Rows for which OpenCV is asked pixel by pixel.
    middle = slice(H // 2, H // 2 + 2)
    x, y = np.moveaxis(decode_by_pixels(peer, coded, middle), -1, 0)
    middle_truth = (truth[0][middle], truth[1][middle])
    fractions = decode(images, grid)
    whole = decode(images, grid, subpixel=False)
    facts = {
        "decoded, ours": fractions.decoded,
        f"decoded, opencv, {2 * W} pixels": float(np.mean(np.isfinite(x))),
        "rms, opencv there": rms_distance(x, y, middle_truth),
        "rms, whole numbers": rms_distance(whole.x, whole.y, truth),
        "rms, fractions": rms_distance(fractions.x, fractions.y, truth),
        "nonzeros of the resampling, millions": Resampling.of(fractions).weights.nnz / 1e6,
    }
    report(options, "Gray code into a map", comparisons(rate), facts)


if __name__ == "__main__":
    main()
