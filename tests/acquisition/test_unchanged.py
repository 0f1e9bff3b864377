# SPDX-License-Identifier: BSD-3-Clause
"""Which rigs may go on with a scan: those that describe themselves as before, but for what passes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from ltcl.acquisition import VirtualRig
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.unchanged import refuse_other_rig
from ltcl.errors import InputError

PATH = Path("T.zarr")
TOLD: dict[str, Any] = {
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

    def __init__(self, told: Any) -> None:
        self.told = told

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        return codes

    def describe(self) -> Any:
        return self.told


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"survey": None},
        {"survey": {"latency": 0.08, "worst": 0.1}},
        {"camera": {"kind": "opencv", "source": 2, "locked": {"exposure": True}}},
        {"display": {"index": 0, "driver": "wayland", "block": [2, 2]}},
        {"exposures": (1 / 60, 1 / 30)},
        {"period": 1 / 60 + 1e-9},
        {"shots": 80, "folder": "elsewhere", "seed": 3, "mitsuba": "3.9"},
    ],
)
def test_what_differs_between_sessions_passes(change: dict[str, Any]) -> None:
    refuse_other_rig(TOLD, Shots(Described({**TOLD, **change})), PATH)


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"kind": "virtual"}, "rig.kind is 'virtual', but {path} was begun with 'live'"),
        (
            {"camera": {"kind": "opencv", "source": 0, "locked": {"exposure": False}}},
            "rig.camera.locked.exposure is False, but {path} was begun with True",
        ),
        ({"camera": {"kind": "gphoto2"}}, "rig.camera.kind is 'gphoto2', but {path} was begun with 'opencv'"),
        ({"exposures": [1 / 60]}, "rig.exposures is [0.016"),
        ({"period": None}, "rig.period is None, but {path} was begun with 0.016"),
        ({"iso": "200"}, "rig.iso is '200', but {path} was begun with None"),
    ],
)
def test_another_set_up_is_refused_by_its_key(change: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError) as error:
        refuse_other_rig(TOLD, Shots(Described({**TOLD, **change})), PATH)
    assert part.format(path=PATH) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_store_that_does_not_say_is_refused() -> None:
    with pytest.raises(InputError, match=r"rig\.camera\.kind is 'opencv', but .* was begun with None"):
        refuse_other_rig([1, 2], Shots(Described(TOLD)), PATH)


def test_a_rig_that_says_nothing_goes_on() -> None:
    silent = Described(None)
    silent.describe = None  # pyright: ignore[reportAttributeAccessIssue]
    refuse_other_rig({"kind": "Described"}, Shots(silent), PATH)


T = np.random.default_rng(2).random((12, 12))
MAP = scipy.sparse.random_array((12, 12), density=0.5, rng=np.random.default_rng(3), format="csr")


def other(T: Any) -> Any:
    """The same with one entry that differs by a thousandth."""
    found = T.copy()
    found[3, 4] = 1.001 * found[3, 4] + 1e-3
    return found


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({}, None),
        ({"T": T.copy()}, None),
        ({"T": other(T)}, "transport"),
        ({"T": [T, T, other(T)]}, "transport"),
        ({"T": scipy.sparse.coo_array(other(T))}, "transport"),
        ({"T": aslinearoperator(1.01 * T)}, "transport"),
        ({"camera_map": MAP}, "camera_map"),
        ({"ambient": np.linspace(0, 0.02, 12)}, "ambient"),
    ],
)
def test_a_virtual_rig_of_another_scene_does_not_go_on(change: dict[str, Any], name: str | None) -> None:
    made = {"T": T, "grid": (3, 4), "ambient": 0.01}
    if isinstance(change.get("T"), list):
        made["T"] = [T] * 3
    if scipy.sparse.issparse(change.get("T")):
        made["T"] = scipy.sparse.csr_array(T)
    if isinstance(change.get("T"), LinearOperator):
        made["T"] = aslinearoperator(T)
    told = VirtualRig(**made).describe()
    shots = Shots(VirtualRig(**{**made, **change}))
    if name is None:
        refuse_other_rig(told, shots, PATH)
        return
    with pytest.raises(InputError, match=rf"rig\.digests\.{name} is .*, but .* was begun with"):
        refuse_other_rig(told, shots, PATH)


@pytest.mark.parametrize("kind", [scipy.sparse.csr_array, scipy.sparse.csc_array, aslinearoperator])
def test_a_sparse_or_implicit_scene_is_the_same_again(kind: Any) -> None:
    told = VirtualRig(kind(T), (3, 4)).describe()
    refuse_other_rig(told, Shots(VirtualRig(kind(T.copy()), (3, 4))), PATH)
