# SPDX-License-Identifier: BSD-3-Clause
"""The tables of an acquisition.toml, for `project`, checked before anything is opened."""

from __future__ import annotations

import inspect
import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.acquisition import rigs
from ltcl.acquisition.projectors.warp import MIN_SIDE
from ltcl.acquisition.rigs.simulated import Sensor
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.files import input_file

RIGS: dict[str, Any] = {
    "virtual": rigs.VirtualRig,
    "mitsuba": rigs.MitsubaRig,
    "folder": rigs.FolderRig,
    "live": rigs.LiveRig,
}
CAMERAS: dict[str, Any] = {
    "opencv": rigs.OpenCVCamera,
    "gphoto2": rigs.GPhoto2Camera,
}
# Arguments of rigs that are objects, which no file has.
OBJECT_ARGUMENTS = frozenset({"T", "folder"})
# Names of projectors, of which those of files are made; and their number.
PROJECTOR_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}")
MAX_PROJECTORS = 8
# Names of other files in the folder.
TAKEN_NAMES = ("transport", "updated", "checks", "end", "patterns", "photographs")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a file; FileError if it is not there, or not valid TOML."""
    if not path.exists():
        raise FileError(
            f"{path}: no such file; docs/guide/acquisition.md and 'ltcl simulate' show one"
        )
    try:
        text = input_file(path).read_text(encoding="utf-8-sig")
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileError(f"{path}: is not valid TOML: {error}") from None


def check_tables(path: Path, content: Mapping[str, Any]) -> None:
    """Refuse other tables than those of an acquisition."""
    kinds = {"rig": dict, "acquire": dict, "scene": dict, "projector": list}
    for name, value in content.items():
        if not isinstance(value, kinds.get(name, ())):
            raise InputError(
                f"{path}: has {name!r}; it must have the tables [rig] and [acquire] only, and for "
                "several projectors [[projector]] and [scene]"
            )


def check_rig(path: Path, name: str, content: Any) -> dict[str, Any]:
    """The checked table of a rig."""
    table = _check_kind(path, name, content, RIGS)
    if table["kind"] == "live":
        camera = table["camera"]
        display = table["display"]
        table["camera"] = _check_kind(path, f"{name}.camera", camera, CAMERAS)
        table["display"] = check_table(path, f"{name}.display", display, rigs.Display)
    return table


def projector_tables(path: Path, content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The table of the rig of each projector, by its name: that of all, and its own keys."""
    shared = content.get("rig", {})
    entries = content["projector"]
    if not 2 <= len(entries) <= MAX_PROJECTORS:
        raise InputError(
            f"{path}: has {len(entries)} [[projector]]; it must have 2 to {MAX_PROJECTORS}, or "
            "[rig] alone"
        )
    tables: dict[str, dict[str, Any]] = {}
    # Some file systems take names that differ in case alone for one.
    taken: set[str] = set()
    for number, entry in enumerate(entries, start=1):
        name = entry.get("name", "") if isinstance(entry, dict) else ""
        is_name = isinstance(name, str) and PROJECTOR_NAME.fullmatch(name) is not None
        if is_name and name.lower() in TAKEN_NAMES:
            raise InputError(
                f"{path}: [[projector]] {number} has the name {name!r}, which is that of other "
                f"files here; it must be none of {', '.join(TAKEN_NAMES)}"
            )
        if is_name and name.lower() in taken:
            raise InputError(
                f"{path}: [[projector]] {number} has the name {name!r}, as one before it, but for "
                "case at most; each must have one of its own"
            )
        if not is_name:
            raise InputError(
                f"{path}: [[projector]] {number} has the name {name!r}; it must be 1 to 32 "
                "letters, digits, - and _, beginning with a letter or digit, as files get it"
            )
        own = {key: value for key, value in entry.items() if key != "name"}
        tables[name] = {**shared, **own}
        taken.add(name.lower())
    return tables


def settings_of_several(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """The table [acquire] without the geometry, which is that of the camera's pixels."""
    geometry = settings.get("geometry", "graycode")
    if geometry != "graycode":
        raise InputError(
            f"{path}: [acquire] geometry is {geometry!r}; with several projectors it must be "
            "'graycode', or left out"
        )
    if settings.get("strategy") == "block":
        raise InputError(
            f"{path}: [acquire] strategy is 'block'; with several projectors the side of [scene] "
            "makes T coarser"
        )
    return {key: value for key, value in settings.items() if key != "geometry"}


def check_side(path: Path, table: Any) -> int | None:
    """Camera pixels along a side of a pixel of T, from the table [scene]."""
    for key in table:
        if key != "side":
            raise InputError(f"{path}: [scene] has {key!r}; it may have side")
    side = table.get("side")
    if side is None:
        return None
    try:
        return checks.count("side", side, least=MIN_SIDE)
    except (InputError, InputTypeError) as error:
        raise type(error)(f"{path}: [scene] {error}") from None


def _check_kind(path: Path, name: str, table: Any, classes: Mapping[str, Any]) -> dict[str, Any]:
    """Check a table whose key "kind" says of which class its other keys are arguments."""
    _check_is_table(path, name, table)
    kind = table.get("kind")
    if kind not in list(classes):
        kinds = ", ".join(classes)
        raise InputError(f"{path}: [{name}] kind is {kind!r}; it must be one of {kinds}")
    return check_table(path, name, table, classes[kind], {"kind": True})


def check_table(
    path: Path,
    name: str,
    table: Any,
    make: Callable[..., Any],
    more_keys: Mapping[str, bool] | None = None,
) -> dict[str, Any]:
    """Check that a table has the arguments of `make`, and more keys; "none" becomes None.

    `more_keys` says of each whether it is required.
    """
    _check_is_table(path, name, table)
    required = {} if more_keys is None else dict(more_keys)
    for key, parameter in _parameters(make).items():
        if key not in OBJECT_ARGUMENTS:
            required[key] = parameter.default is parameter.empty
    if make is rigs.VirtualRig:
        # The transport is a file, which may have the grid.
        required |= {"transport": True, "grid": False}
    for key in table:
        if key not in required:
            allowed = ", ".join(required)
            raise InputError(f"{path}: [{name}] has {key!r}; it may have {allowed}")
    for key, is_required in required.items():
        if is_required and key not in table:
            raise InputError(f"{path}: [{name}] has no {key!r}; it must be there")
    checked = dict(table)
    for key, value in table.items():
        if value == "none":
            checked[key] = None
    return checked


def _check_is_table(path: Path, name: str, table: Any) -> None:
    if not isinstance(table, dict):
        raise InputError(f"{path}: has no table [{name}]; it must have one")


def _parameters(make: Callable[..., Any]) -> dict[str, inspect.Parameter]:
    """Parameters of a class, with those of the sensor of a simulated rig."""
    parameters = dict(inspect.signature(make).parameters)
    if "sensor" in parameters:
        del parameters["sensor"]
        parameters |= inspect.signature(Sensor).parameters
    return parameters
