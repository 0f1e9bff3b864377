# SPDX-License-Identifier: BSD-3-Clause
"""Seven real photographs of a room, 2 s to 1/4000 s by their EXIF: ../shared/data/hdr-stack-real.

EXIF rounds: 1/30 stands for 1/32 and 1/125 for 1/128, as the steps of a shutter are powers of two. The two
shortest photographs show little but a lamp, on less than a fiftieth of the pixels, whose light is not the
same in all of them; each other pair of neighbours is told by more pixels, up to a third.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ltcl.acquisition.radiometry import NoiseModel, Response, calibrate, consistency, merge

EXIF, EXPOSURE_TIME = 0x8769, 33434


@dataclass(frozen=True)
class Room:
    images: list[np.ndarray]
    seconds: np.ndarray
    response: Response


@pytest.fixture(scope="module")
def room(shared_data: Path) -> Room:
    images, seconds = [], []
    for path in sorted((shared_data / "hdr-stack-real").glob("*.jpg")):
        with Image.open(path) as image:
            images.append(np.array(image))
            seconds.append(float(image.getexif().get_ifd(EXIF)[EXPOSURE_TIME]))
    steps = 2.0 ** np.round(np.log2(seconds))
    return Room(images, steps, calibrate(images, steps))


def test_the_exposures_are_those_of_the_readme(room):
    assert len(room.images) == 7
    assert (room.seconds.max(), room.seconds.min()) == (2.0, 2.0**-12)
    assert {image.shape for image in room.images} == {(427, 640, 3)}


def test_the_response_is_monotone(room):
    assert room.response.channels == 3
    assert np.all(np.diff(room.response.values, axis=1) > 0)
    assert np.all(np.abs(room.response.values[:, 0]) < 0.01)  # code 0 is as good as no light


def test_light_is_consistent_across_exposures(room):
    """Ratios of light against ratios of seconds: medians to 5 %, in every channel."""
    off = consistency(room.images, room.seconds, room.response)
    seen = off[..., 2] > 0.02
    assert np.all(seen[2:])
    assert not np.any(seen[:2])  # the lamp
    assert np.abs(off[2:, :, 0]).max() < 0.05


def test_every_part_of_the_stack_merges_to_the_same_radiance(room):
    noise = NoiseModel(2000.0, 0.003, saturation=0.9)
    whole = merge(room.images, room.seconds, room.response, noise)
    assert whole.valid.mean() > 0.999
    assert np.all(np.isfinite(whole.value))
    low, high = np.quantile(whole.value[whole.valid], [0.001, 0.999])
    assert high / low > 1e4  # one photograph has 255
    odd, even = (merge(room.images[k::2], room.seconds[k::2], room.response, noise) for k in (0, 1))
    # Where both have a clear photograph, they agree.
    told = [part.valid & (part.variance < (0.1 * part.value) ** 2) for part in (odd, even)]
    both = told[0] & told[1]
    assert both.mean() > 0.5
    assert abs(np.median(np.log(odd.value[both] / even.value[both]))) < 0.03
