# SPDX-License-Identifier: BSD-3-Clause
"""`Shots` scales, counts, and refuses what goes in or comes back wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Shots
from ltcl.errors import AcquisitionError, InputError, InputTypeError, PhotographMissing

random = np.random.default_rng()
CODES = np.full((2, 3), 0.5)


class Scripted:
    """A rig that gives one image after another, or raises what is no image."""

    projector_grid: tuple[int, int] = (2, 3)
    channels: int = 1

    def __init__(self, *images: Any, **members: Any) -> None:
        self.images, self.seen = list(images), []
        vars(self).update(members)

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self.seen.append((codes, seconds))
        if isinstance(image := self.images.pop(0), Exception):
            raise image
        return image


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
def test_codes_are_scaled_by_full_scale(
    image: np.ndarray, bits: int | None, levels: int | None
) -> None:
    shots = Shots(Scripted(image, bits=bits))
    assert (shots.levels, shots.camera_grid) == (None, None)
    scaled = shots.photograph(CODES, 1.0)
    assert scaled.dtype == np.float32
    np.testing.assert_allclose(
        scaled, [[0.0, 0.2, 1.0]], rtol=3e-4 if image.dtype == np.float16 else 1e-6
    )
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
        *((np.zeros(shape), 1.0, "codes has shape") for shape in ((3, 2), (2, 3, 3))),
        *((CODES * factor, 1.0, "codes") for factor in (np.nan, 2.02, -0.2)),
        *(
            (CODES, seconds, f"seconds is '?{seconds}")
            for seconds in (0.0, np.nan, "1", 31.0, 1e-5)
        ),
    ],
)
def test_bad_requests_never_reach_the_rig(codes: Any, seconds: Any, part: str) -> None:
    rig = Scripted(prepare=list)
    shots = Shots(rig)
    for call in (shots.photograph, lambda *shot: shots.prepare([shot])):
        with pytest.raises(InputError, match=part):
            call(codes, seconds)
    assert (rig.seen, shots.count) == ([], 0)


SMALL = np.zeros((2, 2), np.uint8)


@pytest.mark.parametrize(
    ("images", "part"),
    [
        ([SMALL, SMALL[:1]], "photograph 2 is uint8 (1, 2); it must be"),
        ([SMALL, SMALL.astype(np.uint16)], "photograph 2 is uint16"),
        ([np.array([[1e39, 1.0]])], "photograph 1 has 1 NaN or infinite"),
        *(
            ([x], f"photograph 1 has shape {x.shape}")
            for x in (SMALL[:0], SMALL[0], np.zeros((2, 2, 3)))
        ),
        *(
            ([x], f"photograph 1 holds {np.asarray(x).dtype}")
            for x in (SMALL.astype(np.int32), None)
        ),
        ([np.full((1, 1), 4096, np.uint16)], "photograph 1 reaches 4096; by rig.bits"),
        ([SMALL, OSError("it\nis gone")], "photograph 2: the rig failed with OSError: it is gone"),
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
    ("members", "part"),
    [
        ({"channels": 2}, "rig.channels is 2"),
        ({"projector_grid": (0, 3)}, "projector_grid"),
        *(
            ({"exposures": e}, "rig.exposures")
            for e in ([], [0.1, 0.1], [1.0, 0.5], [0.0, 1.0], [[1.0]])
        ),
        *(
            ({"describe": lambda facts=facts: facts}, r"rig\.describe.*JSON")
            for facts in ({1, 2}, [np.nan])
        ),
    ],
)
def test_what_is_no_rig_is_refused(members: dict[str, Any], part: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=part):
        Shots(Scripted(**members))
    nothing: Any = object()
    with pytest.raises(
        InputTypeError, match="rig is a object without projector_grid, channels, photograph"
    ):
        Shots(nothing)


def test_optional_members_are_used_where_they_are() -> None:
    calls = []
    members: dict[str, Any] = {"prepare": calls.extend, "close": lambda: calls.append("closed")}
    members |= {
        "describe": lambda: {"kind": "scripted"},
        "file_name": lambda number: f"photo_{number}.png",
    }
    with Shots(Scripted(number=7, **members)) as shots:
        shots.prepare([(CODES, 1)])
        assert shots.describe()["rig"] == {"kind": "scripted"}
        assert (shots.number, shots.name(7)) == (7, "photograph 7 (photo_7.png)")
    assert (calls[0][1], calls[1]) == (1.0, "closed")
    plain = Shots(Scripted())
    plain.prepare([(CODES, 1.0)])
    assert (plain.number, plain.name(7)) == (0, "photograph 7")
