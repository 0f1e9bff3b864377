# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a calibration that contradict each other: which ones explain that."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ltcl.acquisition import VirtualRig
from ltcl.acquisition.agreement import AgreementRecord, CameraModel, name_by_number
from ltcl.acquisition.contradictions import Contradictions, Explanation, first_of_fewer_bits
from ltcl.acquisition.metering import OtherLight, check_full_scale
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.session import acquisition_error
from ltcl.errors import AcquisitionError, InputError

GRID = (24, 24)
LEVELS = 4096
BLACK_LEVEL = 0.02
READ_NOISE = 0.001
ELECTRONS = 5000.0
CAMERA = CameraModel(
    response=Response.identity(),
    noise=NoiseModel(ELECTRONS, READ_NOISE, levels=LEVELS),
    offset=BLACK_LEVEL,
)
# Number of the first photograph.
FIRST = 8


def set_up() -> list[np.ndarray]:
    """Codes of a set-up, in the order of its photographs 8 to 30."""
    x = np.arange(GRID[1])
    codes = []
    for axis_codes in (x, x[:, None]):
        for width in (2, 4, 8):
            stripes = np.broadcast_to(axis_codes // width % 2, GRID).astype(np.float32)
            codes += [stripes, 1 - stripes]
    white = np.ones(GRID, np.float32)
    random = np.random.default_rng(4)
    blocks = np.kron(random.random((8, 8)) < 0.5, np.ones((3, 3))).astype(np.float32)
    codes += [white, 0 * white, blocks, 0 * white, white]
    codes += [np.full(GRID, code, np.float32) for code in (0.2, 0.4, 0.7, 0.9)]
    return [*codes, blocks, 1 - blocks]


def photographs(codes: list[np.ndarray], moved_from: int | None = None) -> list[np.ndarray]:
    """Photographs of codes with noise; from a number on the camera is moved by three pixels."""
    random = np.random.default_rng(7)
    scene = 0.3 + 0.4 * random.random(GRID)
    images = []
    for number, pattern in enumerate(codes, FIRST):
        light = scene * (0.9 * pattern + 0.1 * pattern.mean()) + 0.01
        if moved_from is not None and number >= moved_from:
            light = np.roll(light, 3, axis=1)
        value = random.poisson(light * ELECTRONS) / ELECTRONS
        value = value + random.normal(0, READ_NOISE, GRID) + BLACK_LEVEL
        images.append(np.rint(np.clip(value, 0, 1) * (LEVELS - 1)) / (LEVELS - 1))
    return images


def record(images: list[np.ndarray]) -> AgreementRecord:
    """A record of photographs 8, 9, ... of the set-up."""
    result = AgreementRecord()
    for number, (codes, image) in enumerate(zip(set_up(), images, strict=True), FIRST):
        result.add(codes, 1.0, image, number)
    return result


def explain(images: list[np.ndarray]) -> Explanation:
    """What explains the contradictions among photographs 8, 9, ... of the set-up."""
    return Contradictions(record(images).photographs, CAMERA).explain()


def described(images: list[np.ndarray]) -> str:
    """The same in words."""
    return str(explain(images).describe(name_by_number))


def test_nothing_is_explained_where_all_agree() -> None:
    images = photographs(set_up())
    assert record(images).first_finding(CAMERA) is None
    assert explain(images) == Explanation(single=(), changes=(), pairs=())
    assert explain(images).describe(name_by_number) is None


@pytest.mark.parametrize(
    ("number", "suspects"), [(20, (20,)), (22, (22, 29)), (24, (24,)), (29, (29,))]
)
def test_a_single_photograph(number: int, suspects: tuple[int, ...]) -> None:
    """White, blocks, white again, and blocks at the end, which add up with their inverse."""
    codes = set_up()
    codes[number - FIRST] = codes[4]
    explanation = explain(photographs(codes))
    assert explanation.single == suspects
    text = explanation.describe(name_by_number)
    names = " or ".join(map(name_by_number, suspects))
    assert f"{names} deviates from others of the same light" in str(text)


@pytest.mark.parametrize(
    ("start", "changes"),
    [(14, (14, 15)), (20, (20,)), (27, (26, 27)), (26, (26,))],
)
def test_what_is_in_between_tells_when_the_camera_moved(
    start: int, changes: tuple[int, ...]
) -> None:
    """Sums of stripes and uniform codes are compared with white; blocks alone say 23 to 29."""
    explanation = explain(photographs(set_up(), start))
    assert start in explanation.changes
    assert set(explanation.changes) <= set(changes) | {start - 1, start, start + 1}
    assert explanation.single == ()
    assert "the camera or scene moved" in str(explanation.describe(name_by_number))


def test_a_range_in_which_something_changed() -> None:
    """Two photographs of black say nothing about a camera that moves between them."""
    explanation = Explanation(single=(), changes=(21, 22, 23), pairs=())
    text = explanation.describe(name_by_number)
    assert "photographs deviate from one of photographs 21 to 23 on" in str(text)
    explanation = Explanation(single=(), changes=tuple(range(28, 40)), pairs=())
    text = explanation.describe(name_by_number)
    expected = "photograph 39 and those after it deviate, and perhaps some of photographs 28 to 38"
    assert expected in str(text)


def test_two_neighbours_that_are_exchanged() -> None:
    codes = set_up()
    place = 28 - FIRST
    codes[place], codes[place + 1] = codes[place + 1], codes[place]
    text = described(photographs(codes))
    assert "photograph 28 and photograph 29 deviate: they are exchanged" in text


def test_more_than_a_change_is_not_explained() -> None:
    """A photograph is missing, and all others move up: they agree with nothing."""
    codes = set_up()
    images = photographs([*codes[:12], *codes[13:], codes[-1]])
    assert described(images) == "None"


def through_eight_bits(image: np.ndarray) -> np.ndarray:
    """A photograph as a file of 8 bits keeps it."""
    codes = np.rint(image * (LEVELS - 1)).astype(int)
    return (codes >> 4 << 4) / (LEVELS - 1)


def test_fewer_bits_from_one_photograph_on() -> None:
    images = photographs(set_up())
    assert first_of_fewer_bits(record(images).photographs, LEVELS) is None
    coarse = [*images[:9], *map(through_eight_bits, images[9:])]
    found = first_of_fewer_bits(record(coarse).photographs, LEVELS)
    assert found is not None
    assert (found.first, found.bits) == (FIRST + 9, 8)
    text = found.describe(name_by_number)
    assert "photograph 17 and those after it have codes of 8 bits alone, as JPEG has" in text
    every = list(map(through_eight_bits, images))
    assert first_of_fewer_bits(record(every).photographs, LEVELS) is None
    assert first_of_fewer_bits(record(coarse).photographs, None) is None


Change = Callable[[np.ndarray, np.ndarray], np.ndarray]


@pytest.mark.parametrize(
    "change", [lambda short, long: short, lambda short, long: short[::-1]], ids=["same", "other"]
)
def test_another_picture_is_no_full_camera(change: Change) -> None:
    """White of a longer exposure is a copy, or another picture: neither says where it is full."""
    shots = Shots(VirtualRig(np.eye(4), (2, 2), bits=12))
    light = np.random.default_rng(1).uniform(0.02, 0.6, (32, 32))
    light[:16] *= 0.5
    images = [light, change(light, np.minimum(4 * light, 0.6))]
    names = ["photograph 6", "photograph 7"]
    with pytest.raises(OtherLight, match=r"photograph 7 of 0.4 s and photograph 6 of 0.1 s show"):
        check_full_scale(shots, [0.1, 0.4], images, names)
    full = [np.minimum(light, 0.55), np.minimum(4 * light, 0.55)]
    with pytest.raises(AcquisitionError, match="is full at"):
        check_full_scale(shots, [0.1, 0.4], full, names)


def test_images_are_named_as_photographs() -> None:
    message = "the response: photograph 4 is not brighter than photograph 3"
    names = ["photograph 3", "photograph 4"]
    with (
        pytest.raises(AcquisitionError, match=message),
        acquisition_error("the response", names),
    ):
        raise InputError("images[1] is not brighter than images[0]")
