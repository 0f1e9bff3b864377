# SPDX-License-Identifier: BSD-3-Clause
"""What a folder of patterns says of itself: from which T, with which settings, which frames are done.

Replaced whole after every batch, when its patterns are on the disk: what ends a run early costs one
batch.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.errors import InputError
from ltcl.files import input_file, replace_file
from ltcl.store.guards import about
from ltcl.tasks import report
from ltcl.transport.fingerprint import fingerprint
from ltcl.transport.transport import Transport

NAME = "frames.json"
_FORMAT = 2
_FEW = 8  # numbers are shown as they are, more by a digest
_LEVELS = 9  # of light, at which the curves of projectors are compared


class OtherRun(InputError):
    """What is to be resumed is not what was begun."""


@dataclass(frozen=True)
class Record:
    """A frame: number, from 1, name, SHA-256 of what was read; error and clipped as of a Compensation."""

    number: int
    name: str
    digest: str
    error: float
    clipped: float


def write(folder: Path, head: dict[str, Any], records: dict[int, Record]) -> None:
    """Replace the list of a folder: `head` has versions, settings, transport and gain of the run."""
    text = report.dumps({"format": _FORMAT, **head})
    frames = ",\n    ".join(json.dumps(vars(records[number])) for number in sorted(records))
    with replace_file(folder / NAME) as temporary:
        temporary.write_text(
            f'{text[:-2]},\n  "frames": [\n    {frames}\n  ]\n}}\n', encoding="utf-8"
        )


def read(folder: Path, head: dict[str, Any], resume: bool) -> dict[int, Record]:
    """Records of the run to go on with, and its gain in `head`; refuses another run, and no `resume`."""
    path, advice = folder / NAME, "give the same to go on with it, or another folder"
    if not path.exists():
        return {}
    with about(path, reading=True):
        content = json.loads(input_file(path).read_text(encoding="utf-8"))
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']!r}")
        records = {int(entry["number"]): Record(**entry) for entry in content["frames"]}
        head["gain"], settings = float(content["gain"]), dict(content["settings"])
        transport = {
            **content["transport"],
            "error": head["transport"]["error"],
        }  # that of the first bounce
    if not resume:
        count = f"{folder}: holds {len(records)} frame(s) of an earlier run"
        raise InputError(
            f"{count}; give resume=True (--resume) to go on with it, or another folder"
        )
    for name in sorted({*head["settings"], *settings}):
        before, now = settings.get(name), head["settings"].get(name)
        if before != now:
            raise OtherRun(
                f"{path}: that run had {name}={before!r}, this one has {now!r}; {advice}"
            )
    if transport != head["transport"]:
        raise OtherRun(f"{path}: that run was with another T; {advice}")
    return records


def identity(T: Transport) -> dict[str, Any]:
    """Sizes, error and fingerprint of T; not the first bounce, on which compensation does not depend."""
    matrices = T.matrices if T.blocks is None else [block for row in T.blocks for block in row]
    mixing = [] if T.mixing is None else [T.mixing]
    sizes = {"grid": list(T.grid), "camera_grid": list(T.camera_grid), "channels": T.channels}
    return {**sizes, "error": T.error, "digest": fingerprint(T.masked, *mixing, *matrices)}


def setting(value: Any) -> Any:
    """A setting in the types of JSON: pictures and transports by a digest, other objects by their repr."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, Transport):
        return f"Transport, sha256 {identity(value)['digest']}"
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        text = repr(value)
        return type(value).__name__ if " at 0x" in text else text  # an address is of one run
    if array.size <= _FEW:
        return array.tolist()
    return f"{' x '.join(map(str, array.shape))}, sha256 {fingerprint(array.astype(np.float64))}"


def curve(codes: Callable[[np.ndarray], np.ndarray], grid: tuple[int, int]) -> str:
    """By what a projector's curve is known again: its codes for some levels of light, and for a ramp."""
    ramp = np.linspace(0.0, 1.0, grid[0] * grid[1], dtype=np.float32).reshape(grid)
    levels = [np.full(grid, level, np.float32) for level in np.linspace(0.0, 1.0, _LEVELS)]
    return f"sha256 {fingerprint(*(np.rint(65535 * np.asarray(codes(light))) for light in (*levels, ramp)))}"
