# SPDX-License-Identifier: BSD-3-Clause
"""Seven real photographs of a room, 2 s to 1/4000 s by their EXIF: ../shared/data/hdr-stack-real.

EXIF rounds: 1/30 stands for 1/32 and 1/125 for 1/128, as the steps of a shutter are powers of two.
The two shortest photographs show little but a lamp, on less than a fiftieth of the pixels, whose
light is not the same in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ltcl.acquisition.radiometry import NoiseModel, Response, calibrate, merge

EXIF = 0x8769
EXPOSURE_TIME = 33434


@dataclass(frozen=True)
class Room:
    """Photographs, their exposures, and the response estimated from them."""

    images: list[np.ndarray]
    seconds: np.ndarray
    response: Response


@pytest.fixture(scope="module")
def room(shared_data: Path) -> Room:
    images = []
    seconds = []
    for path in sorted((shared_data / "hdr-stack-real").glob("*.jpg")):
        with Image.open(path) as image:
            images.append(np.array(image))
            seconds.append(float(image.getexif().get_ifd(EXIF)[EXPOSURE_TIME]))
    steps = 2.0 ** np.round(np.log2(seconds))
    assert (len(steps), steps.max(), steps.min()) == (7, 2.0, 2.0**-12)
    return Room(images, steps, calibrate(images, steps))


def test_the_response_is_monotone(room):
    assert room.response.channels == 3
    assert np.all(np.diff(room.response.values, axis=1) > 0)
    assert np.all(np.abs(room.response.values[:, 0]) < 0.01)  # code 0 is as good as no light


def test_ratios_of_light_are_ratios_of_seconds(room):
    """Medians over the pixels that both photographs show, to 5 % in every channel."""
    order = np.argsort(room.seconds)[2:]  # without those of the lamp
    light = [room.response.linear(room.images[k].astype(np.float32) / 255) for k in order]
    for k, (short, long) in enumerate(pairwise(light)):
        ratio = room.seconds[order[k + 1]] / room.seconds[order[k]]
        for c in range(3):
            seen = (short[..., c] > 0.05) & (long[..., c] < 0.95)
            assert seen.mean() > 0.02
            assert np.median(long[seen, c] / short[seen, c]) == pytest.approx(ratio, rel=0.05)


def test_every_part_of_the_stack_merges_to_the_same_radiance(room):
    noise = NoiseModel(2000.0, 0.003, saturation=0.9)
    whole = merge(room.images, room.seconds, room.response, noise)
    assert whole.valid.mean() > 0.999
    low, high = np.quantile(whole.value[whole.valid], [0.001, 0.999])
    assert high / low > 1e4  # a photograph has 255
    even = merge(room.images[0::2], room.seconds[0::2], room.response, noise)
    odd = merge(room.images[1::2], room.seconds[1::2], room.response, noise)
    both = (odd.variance < (0.1 * odd.value) ** 2) & (even.variance < (0.1 * even.value) ** 2)
    assert both.mean() > 0.5
    assert abs(np.median(np.log(odd.value[both] / even.value[both]))) < 0.03
