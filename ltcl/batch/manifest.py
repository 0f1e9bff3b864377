# SPDX-License-Identifier: BSD-3-Clause
"""List of a folder of patterns, frames.json: its transport, its settings, its finished frames.

The list is replaced whole after every batch, when the patterns of the batch are on the disk: a run
that ends early loses one batch.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
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
FORMAT = 2
# Settings of more numbers than these are kept as a digest.
MAX_LISTED_NUMBERS = 8
# Levels of light at which the curves of projectors are compared.
CURVE_LEVELS = 9


class OtherRun(InputError):
    """The run that is to be resumed is not the one that was begun."""


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """Entry of a frame of a film.

    Attributes
    ----------
    number : int, from 1
    name : str
    digest : str, SHA-256 of what was read
    output_digest : str, SHA-256 of the files that were written
    error, clipped : float, as in a `Compensation`
    """

    number: int
    name: str
    digest: str
    output_digest: str
    error: float
    clipped: float


def write(folder: Path, head: dict[str, Any], records: dict[int, FrameRecord]) -> None:
    """Replace the list of a folder; `head` has versions, settings, transport and gain."""
    head_text = report.dumps({"format": FORMAT, **head})
    lines = [json.dumps(asdict(records[number])) for number in sorted(records)]
    frames = ",\n    ".join(lines)
    # One line a frame, in the place of the brace that ends the head.
    text = f'{head_text[:-2]},\n  "frames": [\n    {frames}\n  ]\n}}\n'
    with replace_file(folder / NAME) as temporary:
        temporary.write_text(text, encoding="utf-8")


def count(folder: Path) -> int:
    """The number of finished frames of a folder."""
    path = folder / NAME
    if not path.exists():
        return 0
    with about(path, reading=True):
        return len(json.loads(input_file(path).read_text(encoding="utf-8"))["frames"])


def read(folder: Path, head: dict[str, Any], resume: bool) -> dict[int, FrameRecord]:
    """Records of the run to go on with; its gain goes into `head`.

    Refuses a run with another T or other settings, and any earlier run without `resume`.
    """
    path = folder / NAME
    if not path.exists():
        return {}
    with about(path, reading=True):
        content = json.loads(input_file(path).read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        records = {}
        for entry in content["frames"]:
            record = FrameRecord(**entry)
            records[int(record.number)] = record
        gain = float(content["gain"])
        settings = dict(content["settings"])
        # The error of T depends on the first bounce, and compensation does not.
        transport = {**content["transport"], "error": head["transport"]["error"]}
    if not resume:
        count = f"{len(records)} frame(s) of an earlier run"
        advice = "give resume=True (--resume) to go on with it, or another folder"
        raise InputError(f"{folder}: holds {count}; {advice}")
    _check_same_run(path, head, settings, transport)
    head["gain"] = gain
    return records


def _check_same_run(
    path: Path, head: dict[str, Any], settings: dict[str, Any], transport: dict[str, Any]
) -> None:
    advice = "give the same to go on with it, or another folder"
    for name in sorted({*head["settings"], *settings}):
        before = settings.get(name)
        now = head["settings"].get(name)
        if before != now:
            raise OtherRun(
                f"{path}: that run had {name}={before!r}, this one has {now!r}; {advice}"
            )
    if transport != head["transport"]:
        raise OtherRun(f"{path}: that run was with another T; {advice}")


def identity(T: Transport) -> dict[str, Any]:
    """Sizes, error and fingerprint of T.

    The first bounce is left out, as compensation does not depend on it.
    """
    if T.blocks is None:
        arrays = list(T.matrices)
    else:
        arrays = [block for row in T.blocks for block in row]
    if T.mixing is not None:
        arrays.insert(0, T.mixing)
    return {
        "grid": list(T.grid),
        "camera_grid": list(T.camera_grid),
        "channels": T.channels,
        "error": T.error,
        "digest": fingerprint(T.masked, *arrays),
    }


def setting(value: Any) -> Any:
    """A setting in the types of JSON: large pictures and transports by a digest."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, Transport):
        return f"Transport, sha256 {identity(value)['digest']}"
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        text = repr(value)
        has_address = " at 0x" in text  # which differs from run to run
        return type(value).__name__ if has_address else text
    if array.size <= MAX_LISTED_NUMBERS:
        return array.tolist()
    shape = " x ".join(map(str, array.shape))
    return f"{shape}, sha256 {fingerprint(array.astype(np.float64))}"


def curve(codes: Callable[[np.ndarray], np.ndarray], grid: tuple[int, int]) -> str:
    """Digest of a projector's curve: its codes for some levels of light, and for a ramp."""
    lights = []
    for level in np.linspace(0.0, 1.0, CURVE_LEVELS):
        lights.append(np.full(grid, level, np.float32))
    ramp = np.linspace(0.0, 1.0, grid[0] * grid[1], dtype=np.float32)
    lights.append(ramp.reshape(grid))
    levels = [np.rint(65535 * np.asarray(codes(light))) for light in lights]
    return f"sha256 {fingerprint(*levels)}"
