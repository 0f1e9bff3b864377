# SPDX-License-Identifier: BSD-3-Clause
"""`Shots` scales, counts, and refuses what goes in or comes back wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Rig, Shots
from ltcl.errors import AcquisitionError, InputError, InputTypeError, PhotographMissing

CODES = np.full((2, 3), 0.5)


class Scripted:
    """A rig that gives one image after another, or raises what is no image."""

    def __init__(self, *images: Any, channels: int = 1, **more: Any) -> None:
        self.projector_grid: tuple[int, int] = (2, 3)
        self.channels = channels
        self.images = list(images)
        self.seen: list[tuple[np.ndarray, float]] = []
        vars(self).update(more)

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self.seen.append((codes, seconds))
        image = self.images.pop(0)
        if isinstance(image, Exception):
            raise image
        return image


def as_rig(rig: Rig) -> Rig:
    """Pyright reads here that an object of three members is a rig."""
    return rig


@pytest.mark.parametrize(
    ("image", "bits", "levels"),
    [
        (np.array([[0, 51, 255]], np.uint8), None, 256),
        (np.array([[0, 819, 4095]], np.uint16), 12, 4096),
        (np.array([[0, 13107, 65535]], np.uint16), None, 65536),
        (np.array([[0, 0.2, 1.0]], np.float64), None, None),
        (np.array([[0, 0.2, 1.0]], np.float16), None, None),
    ],
)
def test_codes_are_scaled_by_full_scale(image: np.ndarray, bits: int | None, levels: int | None) -> None:
    shots = Shots(as_rig(Scripted(image, bits=bits)))
    assert (shots.levels, shots.camera_grid) == (None, None)
    scaled = shots.photograph(CODES, 1.0)
    assert scaled.dtype == np.float32
    np.testing.assert_allclose(scaled, [[0.0, 0.2, 1.0]], rtol=3e-4 if image.dtype == np.float16 else 1e-6)
    assert (shots.levels, shots.camera_grid, shots.count) == (levels, (1, 3), 1)


def test_the_rig_sees_checked_codes_and_its_own_exposures() -> None:
    rig = Scripted(*[np.ones((4, 4, 3), np.uint8)] * 2, channels=3, exposures=[0.25, 1.0])
    shots = Shots(rig)
    shots.photograph([[0, 1, 0], [1, 0, 1]], 1)
    shots.photograph(np.ones((2, 3, 3), np.float64)[:, ::-1], 0.250001)
    with pytest.raises(InputError, match=r"seconds is 0.2; .* nearest is 0.25"):
        shots.photograph(CODES, 0.2)
    assert [codes.shape for codes, _ in rig.seen] == [(2, 3), (2, 3, 3)]
    assert all(codes.dtype == np.float32 and codes.flags["C_CONTIGUOUS"] for codes, _ in rig.seen)
    assert [seconds for _, seconds in rig.seen] == [1.0, 0.25]


@pytest.mark.parametrize(
    ("codes", "seconds", "part"),
    [
        (np.zeros((3, 2)), 1.0, r"codes has shape \(3, 2\); it must be \(2, 3\)"),
        (np.zeros((2, 3, 3)), 1.0, "codes has shape"),
        (np.full((2, 3), np.nan), 1.0, "NaN"),
        (np.full((2, 3), 1.01), 1.0, r"codes reach from 1.01 to 1.01; they must be in \[0, 1\]"),
        (np.full((2, 3), -0.1), 1.0, "codes reach"),
        (CODES, 0.0, "seconds is 0.0"),
        (CODES, -1.0, "seconds"),
        (CODES, float("nan"), "seconds"),
        (CODES, "1", "seconds"),
        (CODES, 31.0, "seconds is 31.0; .* 0.0001 and at most 30"),
        (CODES, 1e-5, "seconds"),
        ([[0, 1], [1]], 1.0, "ragged"),
    ],
)
def test_bad_requests_never_reach_the_rig(codes: Any, seconds: Any, part: str) -> None:
    rig = Scripted()
    shots = Shots(rig)
    with pytest.raises(InputError, match=part):
        shots.photograph(codes, seconds)
    assert rig.seen == []
    assert shots.count == 0


@pytest.mark.parametrize(
    ("images", "part"),
    [
        (
            [np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8)],
            "photograph 2 is uint8 (2, 3); it must be",
        ),
        ([np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint16)], "photograph 2 is uint16"),
        ([np.array([[0.0, np.nan]])], "photograph 1 has 1 NaN"),
        ([np.array([[0.0, np.inf]])], "photograph 1 has 1 NaN or infinite"),
        ([np.array([[1e39]])], "photograph 1 has 1 NaN or infinite"),
        ([np.zeros((0, 4), np.uint8)], "photograph 1 has shape (0, 4)"),
        ([np.zeros((2, 2, 3), np.uint8)], "photograph 1 has shape (2, 2, 3); it must be (H, W)"),
        ([np.zeros(4, np.uint8)], "photograph 1 has shape (4,)"),
        ([np.zeros((2, 2), np.int32)], "photograph 1 holds int32"),
        ([None], "photograph 1 is None; it must be an image"),
        (
            [np.full((1, 1), 4096, np.uint16)],
            "photograph 1 reaches 4096; by rig.bits the largest code is 4095",
        ),
        ([OSError("the camera\nis gone")], "photograph 1: the rig failed with OSError: the camera is gone"),
        ([np.zeros((1, 1)), RuntimeError("unplugged")], "photograph 2: the rig failed with RuntimeError"),
        ([PhotographMissing("photograph 7 is not there", 7)], "photograph 7 is not there"),
    ],
)
def test_bad_photographs_are_named(images: list[Any], part: str) -> None:
    shots = Shots(Scripted(*images, bits=12))
    for _ in images[1:]:
        shots.photograph(CODES, 1.0)
    with pytest.raises(AcquisitionError) as error:
        shots.photograph(CODES, 1.0)
    assert part in str(error.value)
    assert "\n" not in str(error.value)
    assert shots.count == len(images) - 1  # a refused one does not count


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"channels": 2}, "rig.channels is 2"),
        ({"projector_grid": (0, 3)}, "projector_grid"),
        ({"photograph": None}, "rig is a Scripted without photograph"),
        *(({"exposures": e}, r"rig\.exposures") for e in ([], [0.1, 0.1], [1.0, 0.5], [0.0, 1.0], [[1.0]])),
    ],
)
def test_what_is_no_rig_is_refused(
    change: dict[str, Any], part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Scripted()
    if "photograph" in change:
        monkeypatch.delattr(Scripted, "photograph")
    else:
        vars(rig).update(change)
    with pytest.raises((InputError, InputTypeError), match=part):
        Shots(rig)


def test_the_records_recognize_a_rig_that_says_nothing_of_itself() -> None:
    """By its class, grid, levels, and the first photographs of black and of white, in 8 x 8 cells."""
    light = np.arange(256, dtype=np.uint8).reshape(16, 16)
    shots = Shots(Scripted(light // 4, light // 2, light, light))
    for codes, seconds in [(0 * CODES, 0.5), (CODES, 0.5), (2 * CODES, 0.5), (2 * CODES, 1.0)]:
        shots.photograph(codes, seconds)
    facts = json.loads(json.dumps(shots.describe()))
    assert (facts["rig"], facts["projector_grid"]) == ({"kind": "Scripted"}, [2, 3])
    assert (facts["channels"], facts["levels"]) == (1, 256)
    assert sorted(facts["digest"]) == ["black", "white"]
    assert facts["digest"]["white"]["seconds"] == 0.5
    means = light.reshape(8, 2, 8, 2).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(facts["digest"]["white"]["cells"], means, atol=1e-5)
    np.testing.assert_allclose(facts["digest"]["black"]["cells"], means / 4, atol=0.01)


def test_photographs_are_recorded_with_their_numbers_and_files() -> None:
    records: list[Any] = []
    rig = Scripted(np.zeros((2, 2), np.uint8), number=7, file_name=lambda number: f"photo_{number}.png")
    shots = Shots(rig)
    shots.record = type("Record", (), {"add": lambda self, *shot: records.append(shot)})()
    image = shots.photograph(CODES, 1.0)
    ((codes, seconds, photograph, number),) = records
    np.testing.assert_array_equal(codes, CODES)
    assert (seconds, photograph is image, number) == (1.0, True, 7)
    assert shots.name(7) == "photograph 7 (photo_7.png)"
    assert Shots(Scripted()).name(7) == "photograph 7"


def test_optional_members_are_used_where_they_are() -> None:
    announced, closed = [], []
    end: Callable[[], None] = lambda: closed.append(True)  # noqa: E731
    rig = Scripted(
        prepare=lambda shots: announced.extend(shots), close=end, describe=lambda: {"kind": "scripted"}
    )
    with Shots(rig) as shots:
        shots.prepare([(CODES, 1), (CODES, 0.5)])
        assert shots.describe()["rig"] == {"kind": "scripted"}
    assert [seconds for _, seconds in announced] == [1.0, 0.5]
    assert closed == [True]
    with pytest.raises(InputError, match="codes"):
        shots.prepare([(np.zeros((1, 1)), 1.0)])
    plain = Shots(Scripted())
    plain.prepare([(CODES, 1.0)])
    plain.close()
    assert plain.describe()["rig"] == {"kind": "Scripted"}
