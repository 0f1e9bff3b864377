# SPDX-License-Identifier: BSD-3-Clause
"""`Shots` scales and counts photographs, and refuses bad codes, images and rigs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Shots
from ltcl.errors import AcquisitionError, InputError, InputTypeError, PhotographMissing

CODES = np.full((2, 3), 0.5)
SMALL = np.zeros((2, 2), np.uint8)


class Scripted:
    """A rig that gives one image after another, and raises those that are exceptions."""

    projector_grid: tuple[int, int] = (2, 3)
    channels: int = 1

    def __init__(self, *images: Any, **members: Any) -> None:
        self.images = list(images)
        self.requests: list[tuple[np.ndarray, float]] = []
        for name, member in members.items():
            setattr(self, name, member)

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self.requests.append((codes, seconds))
        image = self.images.pop(0)
        if isinstance(image, Exception):
            raise image
        return image


@pytest.mark.parametrize(
    ("image", "bits", "levels", "rtol"),
    [
        (np.array([[0, 51, 255]], np.uint8), None, 256, 1e-6),
        (np.array([[0, 819, 4095]], np.uint16), 12, 4096, 1e-6),
        (np.array([[0, 13107, 65535]], np.uint16), None, 65536, 1e-6),
        (np.array([[0, 0.2, 1.0]], np.float64), None, None, 1e-6),
        (np.array([[0, 0.2, 1.0]], np.float16), None, None, 3e-4),
    ],
)
def test_codes_are_scaled_by_full_scale(
    image: np.ndarray, bits: int | None, levels: int | None, rtol: float
) -> None:
    shots = Shots(Scripted(image, bits=bits))
    assert shots.levels is None
    assert shots.camera_grid is None
    scaled = shots.photograph(CODES, 1.0)
    assert scaled.dtype == np.float32
    np.testing.assert_allclose(scaled, [[0.0, 0.2, 1.0]], rtol=rtol)
    assert shots.levels == levels
    assert shots.camera_grid == (1, 3)
    assert shots.count == 1


def test_the_rig_sees_checked_codes_and_its_own_exposures() -> None:
    white = np.ones((4, 4, 3), np.uint8)
    rig = Scripted(white, white, channels=3, exposures=[0.25, 1.0])
    shots = Shots(rig)
    shots.photograph([[0, 1, 0], [1, 0, 1]], 1)
    shots.photograph(np.ones((2, 3, 3), np.float64)[:, ::-1], 0.250001)
    with pytest.raises(InputError, match=r"seconds is 0.2; .* nearest is 0.25"):
        shots.photograph(CODES, 0.2)
    (first, long), (second, short) = rig.requests
    assert first.shape == (2, 3)
    assert second.shape == (2, 3, 3)
    assert (long, short) == (1.0, 0.25)
    for codes in (first, second):
        assert codes.dtype == np.float32
        assert codes.flags["C_CONTIGUOUS"]


@pytest.mark.parametrize(
    ("codes", "seconds", "text"),
    [
        (np.zeros((3, 2)), 1.0, "codes has shape"),
        (np.zeros((2, 3, 3)), 1.0, "codes has shape"),
        (CODES * np.nan, 1.0, "codes"),
        (CODES * 2.02, 1.0, "codes"),
        (CODES * -0.2, 1.0, "codes"),
        (CODES, 0.0, "seconds is 0.0"),
        (CODES, np.nan, "seconds is nan"),
        (CODES, "1", "seconds is '1'"),
        (CODES, 31.0, "seconds is 31.0"),
        (CODES, 1e-5, "seconds is 1e-05"),
    ],
)
def test_bad_requests_never_reach_the_rig(codes: Any, seconds: Any, text: str) -> None:
    rig = Scripted(prepare=list)
    shots = Shots(rig)
    with pytest.raises(InputError, match=text):
        shots.photograph(codes, seconds)
    with pytest.raises(InputError, match=text):
        shots.prepare([(codes, seconds)])
    assert rig.requests == []
    assert shots.count == 0


@pytest.mark.parametrize(
    ("images", "text"),
    [
        ([SMALL, SMALL[:1]], "photograph 2 is uint8 (1, 2); it must be"),
        ([SMALL, SMALL.astype(np.uint16)], "photograph 2 is uint16"),
        ([np.array([[1e39, 1.0]])], "photograph 1 has 1 NaN or infinite"),
        ([SMALL[:0]], "photograph 1 has shape (0, 2)"),
        ([SMALL[0]], "photograph 1 has shape (2,)"),
        ([np.zeros((2, 2, 3))], "photograph 1 has shape (2, 2, 3)"),
        ([SMALL.astype(np.int32)], "photograph 1 holds int32"),
        ([None], "photograph 1 holds object"),
        ([np.full((1, 1), 4096, np.uint16)], "photograph 1 reaches 4096; by rig.bits"),
        ([SMALL, OSError("it\nis gone")], "photograph 2: the rig failed with OSError: it is gone"),
        ([PhotographMissing("photograph 7 is not there", 7)], "photograph 7 is not there"),
    ],
)
def test_bad_photographs_are_named(images: list[Any], text: str) -> None:
    """The last of the images is refused, and does not count."""
    shots = Shots(Scripted(*images, bits=12))
    for _ in images[1:]:
        shots.photograph(CODES, 1.0)
    with pytest.raises(AcquisitionError) as error:
        shots.photograph(CODES, 1.0)
    assert text in str(error.value)
    assert "\n" not in str(error.value)
    assert shots.count == len(images) - 1


@pytest.mark.parametrize(
    ("members", "text"),
    [
        ({"channels": 2}, "rig.channels is 2"),
        ({"projector_grid": (0, 3)}, "projector_grid"),
        ({"exposures": []}, "rig.exposures"),
        ({"exposures": [0.1, 0.1]}, "rig.exposures"),
        ({"exposures": [1.0, 0.5]}, "rig.exposures"),
        ({"exposures": [0.0, 1.0]}, "rig.exposures"),
        ({"exposures": [[1.0]]}, "rig.exposures"),
        ({"describe": lambda: {1, 2}}, r"rig\.describe.*JSON"),
        ({"describe": lambda: [np.nan]}, r"rig\.describe.*JSON"),
    ],
)
def test_bad_members_of_a_rig_are_refused(members: dict[str, Any], text: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=text):
        Shots(Scripted(**members))


def test_an_object_that_is_no_rig_is_refused() -> None:
    nothing: Any = object()
    with pytest.raises(InputTypeError, match=r"rig .*projector_grid, channels, photograph"):
        Shots(nothing)


def test_optional_members_are_used_if_a_rig_has_them() -> None:
    announced = []
    closed = []
    rig = Scripted(
        number=7,
        prepare=announced.extend,
        describe=lambda: {"kind": "scripted"},
        file_name=lambda number: f"photo_{number}.png",
        close=lambda: closed.append(True),
    )
    with Shots(rig) as shots:
        shots.prepare([(CODES, 1)])
        assert shots.describe()["rig"] == {"kind": "scripted"}
        assert shots.number == 7
        assert shots.name(7) == "photograph 7 (photo_7.png)"
        assert not closed
    assert [seconds for _, seconds in announced] == [1.0]
    assert closed


def test_optional_members_may_be_missing() -> None:
    with Shots(Scripted()) as shots:
        shots.prepare([(CODES, 1.0)])
        assert shots.number == 0
        assert shots.name(7) == "photograph 7"
