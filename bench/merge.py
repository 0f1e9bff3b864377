# SPDX-License-Identifier: BSD-3-Clause
"""Photographs to radiance, beside OpenCV: megapixels a second, noise of the picture, error of the response.

A smooth scene in three colours at 6 exposures, by a camera with an sRGB curve, 10000 electrons, a
read noise of 0.2 % and a black offset of 0.4 %. A megapixel is one of a photograph, of three
colours. OpenCV merges 8 bits only; its mergers are given the camera's true response, as ours is,
and know nothing of variance and masks. Noise is the root mean square of the relative error, at the
best scale, where ours is valid; so is the error of the response, over linear values from 0.02 to
0.9 above black.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from _harness import Options, Row, parse_options, report, seconds
from ltcl.acquisition.radiometry import NoiseModel, Response, calibrate, merge
from ltcl.images import from_srgb, to_srgb

EXPOSURES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
ELECTRONS = 10000.0
READ_NOISE = 0.002
BLACK = 0.004
MERGERS = {"MergeDebevec": cv2.createMergeDebevec, "MergeRobertson": cv2.createMergeRobertson}
CALIBRATORS = {
    "CalibrateDebevec": cv2.createCalibrateDebevec,
    "CalibrateRobertson": cv2.createCalibrateRobertson,
}


def scene(n: int) -> np.ndarray:
    """Radiance (n, n, 3), from 0.002 to 0.95."""
    y, x = np.mgrid[:n, :n] / n
    waves = [0.5 + 0.5 * np.sin(5 * x + 2 * y + phase) for phase in (0, 1, 2)]
    falloff = np.exp(-3 * y)
    return 0.002 + 0.948 * np.stack(waves, axis=-1) * falloff[..., None]


def photographs(light: np.ndarray, levels: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    integer = np.uint8 if levels == 256 else np.uint16
    shots = []
    for exposure in EXPOSURES:
        electrons = rng.poisson((light * exposure + BLACK) * ELECTRONS)
        values = electrons / ELECTRONS + rng.normal(0, READ_NOISE, light.shape)
        codes = to_srgb(np.clip(values, 0, 1)) * (levels - 1)
        shots.append(np.rint(codes).astype(integer))
    return shots


def scaled_error(measured: np.ndarray, true: np.ndarray) -> float:
    """Root mean square of the relative error, at the best scale."""
    ratio = measured.astype(np.float64) / true
    return float(np.std(ratio) / np.mean(ratio))


def merging_rows(options: Options, n: int) -> list[Row]:
    """Speed of merging, and noise of the merged picture."""
    light = scene(n)
    shots_8 = photographs(light, 256)
    shots_12 = photographs(light, 4096)
    response = Response(from_srgb(np.linspace(0, 1, 4097)))
    noise = NoiseModel(ELECTRONS, READ_NOISE, BLACK)
    theirs = opencv_mergers(shots_8)
    actions: dict[str, Callable[[], object]] = {
        "ours 8": lambda: merge(shots_8, EXPOSURES, response, noise),
        "ours 12": lambda: merge(shots_12, EXPOSURES, response, noise, levels=4096),
        **theirs,
    }
    times = seconds(actions, 1 if options.smoke else 4)
    megapixels = len(EXPOSURES) * n * n / 1e6
    rates = {name: megapixels / spent for name, spent in times.items()}
    rows = []
    for name in MERGERS:
        for bits in (8, 12):
            ours = rates[f"ours {bits}"]
            question = f"merge {len(EXPOSURES)} x {n * n / 1e6:.3g} Mpixel, {bits} bits"
            competitor = f"OpenCV {name}, 8 bits"
            better = ours / rates[name]
            rows.append(Row(question, competitor, rates[name], ours, "Mpixel/s", better))
    merged = merge(shots_8, EXPOSURES, response, noise)
    valid_light = light[merged.valid]
    our_noise = scaled_error(merged.value[merged.valid], valid_light)
    for name, process in theirs.items():
        picture = np.asarray(process())
        their_noise = scaled_error(picture[merged.valid], valid_light)
        question = "noise of the picture, 8 bits"
        rows.append(Row.from_times(question, f"OpenCV {name}", their_noise, our_noise, "rms", 1.0))
    return rows


def opencv_mergers(shots: list[np.ndarray]) -> dict[str, Callable[[], np.ndarray]]:
    """OpenCV's mergers of photographs of 8 bits, with the camera's true response."""
    times = np.array(EXPOSURES, np.float32)
    linear = from_srgb(np.linspace(0, 1, 256)) - BLACK
    table = np.maximum(linear, 1e-6).astype(np.float32)
    curves = np.repeat(table[:, None, None], 3, axis=2)
    mergers = {}
    for name, make in MERGERS.items():
        mergers[name] = partial(make().process, shots, times=times, response=curves)
    return mergers


def response_rows(n: int) -> list[Row]:
    """The response, by three estimators, and how long each takes."""
    shots = photographs(scene(n), 256)
    times = np.array(EXPOSURES, np.float32)

    def estimate(make: Callable) -> np.ndarray:
        curve = make().process(shots, times=times)[:, 0, 0]
        return np.maximum.accumulate(curve.astype(np.float64))

    our_error, our_seconds = judge_response(lambda: calibrate(shots, EXPOSURES).values[0])
    question = f"response of {n} x {n} pixels, 8 bits"
    rows = []
    for name, make in CALIBRATORS.items():
        error, duration = judge_response(partial(estimate, make))
        rows.append(Row.from_times(question, f"OpenCV {name}", error, our_error, "rms", 1.0))
        rows.append(Row.from_times(question, f"OpenCV {name}", duration, our_seconds, "s"))
    return rows


def judge_response(estimate: Callable[[], np.ndarray]) -> tuple[float, float]:
    """Error of an estimated response, and seconds."""
    start = time.perf_counter()
    table = estimate()
    duration = time.perf_counter() - start
    response = Response(table)
    # OpenCV's estimators do not know black: the true one is subtracted.
    zero = response.linear(to_srgb(np.array([BLACK])))
    used = np.linspace(0.02, 0.9, 400)
    linear = response.linear(to_srgb(used + BLACK)) - zero
    return scaled_error(linear, used), duration


def main() -> None:
    options = parse_options(__doc__)
    rows = merging_rows(options, 64 if options.smoke else 1200)
    rows += response_rows(64 if options.smoke else 400)
    facts = {"exposures": len(EXPOSURES), "opencv": cv2.__version__}
    report(options, "Merging exposures", rows, facts)


if __name__ == "__main__":
    main()
