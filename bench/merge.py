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

import itertools
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from _harness import Options, Row, parse_options, report, seconds
from ltcl.acquisition.radiometry import NoiseModel, Response, calibrate, merge
from ltcl.images import from_srgb, to_srgb

SECONDS = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
ELECTRONS, READ, BLACK = 10000.0, 0.002, 0.004
MERGERS = {"MergeDebevec": cv2.createMergeDebevec, "MergeRobertson": cv2.createMergeRobertson}
_ROBERTSON = cv2.createCalibrateRobertson
CALIBRATORS = {"CalibrateDebevec": cv2.createCalibrateDebevec, "CalibrateRobertson": _ROBERTSON}


def scene(n: int) -> np.ndarray:
    """Radiance (n, n, 3), from 0.002 to 0.95."""
    y, x = np.mgrid[:n, :n] / n
    waves = [0.5 + 0.5 * np.sin(5 * x + 2 * y + phase) for phase in (0, 1, 2)]
    return 0.002 + 0.948 * np.stack(waves, axis=-1) * np.exp(-3 * y)[..., None]


def photographs(light: np.ndarray, levels: int) -> list[np.ndarray]:
    rng, kind = np.random.default_rng(0), np.uint8 if levels == 256 else np.uint16
    shots = []
    for t in SECONDS:
        value = rng.poisson((light * t + BLACK) * ELECTRONS) / ELECTRONS + rng.normal(
            0, READ, light.shape
        )
        shots.append(np.rint(to_srgb(np.clip(value, 0, 1)) * (levels - 1)).astype(kind))
    return shots


def error(found: np.ndarray, true: np.ndarray) -> float:
    """Root mean square of the relative error, at the best scale."""
    ratio = found.astype(np.float64) / true
    return float(np.std(ratio) / np.mean(ratio))


def speeds(given: Options, n: int) -> list[Row]:
    light = scene(n)
    shots = {levels: photographs(light, levels) for levels in (256, 4096)}
    response, noise = (
        Response(from_srgb(np.linspace(0, 1, 4097))),
        NoiseModel(ELECTRONS, READ, BLACK),
    )
    times = np.array(SECONDS, np.float32)
    table = np.maximum(from_srgb(np.linspace(0, 1, 256)) - BLACK, 1e-6).astype(np.float32)
    curves = np.repeat(table[:, None, None], 3, axis=2)
    actions: dict[str, Callable[[], object]] = {
        "ours 8": lambda: merge(shots[256], SECONDS, response, noise),
        "ours 12": lambda: merge(shots[4096], SECONDS, response, noise, levels=4096),
    }
    for name, make in MERGERS.items():
        actions[name] = partial(make().process, shots[256], times=times, response=curves)
    spent = seconds(actions, 1 if given.smoke else 4)
    rate = {name: len(SECONDS) * n * n / t / 1e6 for name, t in spent.items()}
    rows = []
    for name, bits in itertools.product(MERGERS, (8, 12)):
        question, ours = (
            f"merge {len(SECONDS)} x {n * n / 1e6:.3g} Mpixel, {bits} bits",
            rate[f"ours {bits}"],
        )
        better = ours / rate[name]
        rows.append(Row(question, f"OpenCV {name}, 8 bits", rate[name], ours, "Mpixel/s", better))
    ours = merge(shots[256], SECONDS, response, noise)
    for name in MERGERS:
        theirs = np.asarray(actions[name]())
        off, own = (error(found[ours.valid], light[ours.valid]) for found in (theirs, ours.value))
        rows.append(
            Row.from_times("noise of the picture, 8 bits", f"OpenCV {name}", off, own, "rms", 1.0)
        )
    return rows


def responses(n: int) -> list[Row]:
    """The response, by three estimators, and how long each takes."""
    shots, times = photographs(scene(n), 256), np.array(SECONDS, np.float32)
    used = np.linspace(0.02, 0.9, 400)
    codes = to_srgb(used + BLACK)

    def timed(action: Callable[[], np.ndarray]) -> tuple[float, float]:
        start = time.perf_counter()
        table = action()
        spent = time.perf_counter() - start
        zero = Response(table).linear(
            to_srgb(np.array([BLACK]))
        )  # theirs do not tell black: it is given
        return error(Response(table).linear(codes) - zero, used), spent

    def theirs(make: Callable) -> np.ndarray:
        return np.maximum.accumulate(make().process(shots, times=times)[:, 0, 0].astype(np.float64))

    own, spent = timed(lambda: calibrate(shots, SECONDS).values[0])
    question, rows = f"response of {n} x {n} pixels, 8 bits", []
    for name, make in CALIBRATORS.items():
        off, duration = timed(partial(theirs, make))
        rows.append(Row.from_times(question, f"OpenCV {name}", off, own, "rms", 1.0))
        rows.append(Row.from_times(question, f"OpenCV {name}", duration, spent, "s"))
    return rows


def main() -> None:
    given = parse_options(__doc__ or "")
    rows = speeds(given, 64 if given.smoke else 1200) + responses(64 if given.smoke else 400)
    report(given, "Merging exposures", rows, {"exposures": len(SECONDS), "opencv": cv2.__version__})


if __name__ == "__main__":
    main()
