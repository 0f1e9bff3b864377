# SPDX-License-Identifier: BSD-3-Clause
"""Which rigs may go on with a scan: those that describe themselves as before, but for volatile keys."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

from ltcl.acquisition import VirtualRig, acquire
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.settings import check_same_rig
from ltcl.errors import AcquisitionError, InputError

from .stopping import LINE, scene

PATH = Path("T.zarr")
LIVE: dict[str, Any] = {
    "kind": "live",
    "camera": {"kind": "opencv", "source": 0, "locked": {"exposure": True}},
    "display": {"index": 1, "driver": "x11", "block": [2, 2]},
    "period": 1 / 60,
    "exposures": [1 / 60, 1 / 30],
    "survey": {"latency": 0.05},
}


class Described:
    """A rig that says this of itself."""

    projector_grid, channels = (2, 2), 1

    def __init__(self, description: Any) -> None:
        self.description = description

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        return codes

    def describe(self) -> Any:
        return self.description


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"survey": {"latency": 0.08, "worst": 0.1}},
        {"camera": {"kind": "opencv", "source": 2, "locked": {"exposure": True}}},
        {"display": {"index": 0, "driver": "wayland", "block": [2, 2]}},
        {"period": 1 / 60 + 1e-9},
        {"shots": 80, "folder": "elsewhere", "seed": 3, "mitsuba": "3.9"},
    ],
)
def test_volatile_keys_may_differ(change: dict[str, Any]) -> None:
    check_same_rig(LIVE, Shots(Described({**LIVE, **change})), PATH)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"kind": "virtual"}, "rig.kind is 'virtual'"),
        (
            {"camera": {"kind": "opencv", "source": 0, "locked": {"exposure": False}}},
            "rig.camera.locked.exposure",
        ),
        ({"camera": {"kind": "gphoto2"}}, "rig.camera.kind is 'gphoto2'"),
        ({"exposures": [1 / 60]}, "rig.exposures is [0.016"),
        ({"period": None}, "rig.period is None"),
        ({"iso": "200"}, "rig.iso is '200'"),
    ],
)
def test_another_set_up_is_refused_by_its_key(change: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError) as error:
        check_same_rig(LIVE, Shots(Described({**LIVE, **change})), PATH)
    assert part in str(error.value)
    assert "\n" not in str(error.value)


T = np.random.default_rng(2).random((12, 12))


@pytest.mark.parametrize("kind", [np.array, scipy.sparse.csr_array, scipy.sparse.coo_array, aslinearoperator])
def test_a_virtual_rig_of_another_scene_is_refused(kind: Any) -> None:
    """One entry differs by a thousandth; of an operator, all."""
    other = T.copy()
    other[3, 4] *= 1.001
    other = other if kind is not aslinearoperator else 1.01 * T
    described = VirtualRig(kind(T), (3, 4)).describe()
    check_same_rig(described, Shots(VirtualRig(kind(T.copy()), (3, 4))), PATH)
    with pytest.raises(InputError, match=r"rig\.digest"):
        check_same_rig(described, Shots(VirtualRig(kind(other), (3, 4))), PATH)


class Plain:
    """A rig of somebody's own, without `describe()`; fails at one of its photographs."""

    channels = 1

    def __init__(self, T: np.ndarray, bits: int = 12, at: int = 10**6) -> None:
        self.projector_grid, self.bits, self._left = (8, 8), bits, at
        self._rig = VirtualRig(T, (8, 8), bits=bits, ambient=0.01, response="linear")

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self._left -= 1
        if self._left == 0:
            raise OSError("unplugged")
        return self._rig.photograph(codes, seconds)


class Another(Plain):
    """The same of another class."""


def test_a_rig_without_a_description_is_known_by_what_it_shows(tmp_path: Path) -> None:
    """Class, bits, and black and white, which are photographed again."""
    given: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "frames": 2, "response": LINE}
    given |= {"exposures": [0.5], "store": tmp_path / "T.zarr"}
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Plain(scene((8, 8)), at=60), **given)
    dim = scene((8, 8)) * np.linspace(0.5, 1.0, 64)[:, None]
    for other, part in (
        (Another(scene((8, 8))), "rig.kind is 'Another'"),
        (Plain(scene((8, 8)), bits=10), "levels"),
        (Plain(dim), "white"),
    ):
        with pytest.raises(InputError, match=part):
            acquire(other, **given)
    assert acquire(Plain(scene((8, 8))), **given).grid == (8, 8)
