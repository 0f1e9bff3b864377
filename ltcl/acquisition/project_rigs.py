# SPDX-License-Identifier: BSD-3-Clause
"""Rigs from the tables of an acquisition.toml: their keys checked, what a plan needs of them, and made.

    virtual    transport: a file; camera_map: a file, what each camera pixel sees (see `VirtualRig`)
    mitsuba    scene: dihedral, trihedral or box, which take albedo, baseline and depth; or a file
    folder     patterns and photographs lie in the folder of the acquisition
    live       [rig.camera] with kind "opencv" or "gphoto2", [rig.display]

All other keys are arguments of the class.
"""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.rigs import (
    Display,
    FolderRig,
    GPhoto2Camera,
    LiveRig,
    MitsubaRig,
    OpenCVCamera,
    VirtualRig,
    mitsuba_scene,
)
from ltcl.acquisition.rigs.mitsuba_scenes import SCENES
from ltcl.errors import InputError
from ltcl.store import Parts, Record, formats, load

Call = Callable[..., Any]
_WALLS = ("albedo", "baseline", "depth")  # of a scene of ours
# What a table may have; arguments that are not for a file, and keys that are no arguments.
_RIGS: dict[str, tuple[Call, tuple[str, ...], tuple[str, ...]]] = {
    "virtual": (VirtualRig, ("T", "grid"), ("transport", "grid")),
    "mitsuba": (MitsubaRig, (), _WALLS),
    "folder": (FolderRig, ("folder",), ()),
    "live": (LiveRig, ("camera", "display"), ()),
}
_CAMERAS: dict[str, Call] = {"opencv": OpenCVCamera, "gphoto2": GPhoto2Camera}
_NOISELESS = 1e9  # electrons


@dataclass(frozen=True)
class Tables:
    """Of a rig: the arguments of its class, and of those of its camera and display."""

    kind: str
    rig: dict[str, Any]
    camera: dict[str, Any] = field(default_factory=dict)
    display: dict[str, Any] = field(default_factory=dict)


def check(path: Path, given: dict[str, Any]) -> Tables:
    """Refuse a kind or a key that is unknown, and miss what has to be there."""
    rig = without_none(given)
    kind = _kind(path, "rig", rig, _RIGS)
    parts = {name: rig.pop(name, None) for name in ("camera", "display")} if kind == "live" else {}
    call, hidden, others = _RIGS[kind]
    check_keys(path, "rig", rig, call, hidden, *others)
    if kind == "virtual" and "transport" not in rig:
        raise InputError(f"{path}: [rig] has no 'transport'; it must be the file of one")
    for name, part in parts.items():
        if not isinstance(part, dict):
            raise InputError(f"{path}: has no table [rig.{name}]; a live rig has a camera and a display")
        parts[name] = without_none(part)
    if parts:
        camera = dict(parts["camera"])
        check_keys(path, "rig.camera", camera, _CAMERAS[_kind(path, "rig.camera", camera, _CAMERAS)], ())
        check_keys(path, "rig.display", parts["display"], Display, ())
    return Tables(kind, rig, **parts)


def check_keys(path: Path, table: str, given: dict[str, Any], call: Call, hidden: Any, *others: str) -> None:
    """Refuse keys that are no arguments of `call`, nor `others`, and miss those that it needs."""
    known = {name: p for name, p in _parameters(call).items() if name not in hidden}
    names = [*others, *known]
    for key in given:
        if key not in names:
            raise InputError(f"{path}: [{table}] has {key!r}; it may have {', '.join(names)}")
    for key, parameter in known.items():
        if parameter.default is parameter.empty and key not in given:
            raise InputError(f"{path}: [{table}] has no {key!r}; it must be there")


def _kind(path: Path, table: str, given: dict[str, Any], kinds: dict[str, Any]) -> str:
    """Taken out of the table."""
    kind = given.pop("kind", None)
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(f"{path}: [{table}] kind is {kind!r}; it must be one of {', '.join(kinds)}")
    return kind


def without_none(table: dict[str, Any]) -> dict[str, Any]:
    """TOML has no None."""
    return {key: None if value == "none" else value for key, value in table.items()}


def _parameters(call: Call) -> dict[str, inspect.Parameter]:
    return dict(inspect.signature(call).parameters)


def make(folder: Path, tables: Tables) -> Any:
    """The rig. Of a live one, the camera is closed again where there is no display."""
    options = dict(tables.rig)
    if tables.kind == "virtual":
        return _virtual(folder, options)
    if tables.kind == "mitsuba":
        return _mitsuba(folder, options)
    if tables.kind == "folder":
        return FolderRig(folder, **options)
    with contextlib.ExitStack() as opened:
        camera = _camera(folder, dict(tables.camera))
        opened.callback(camera.close)
        display = Display(**tables.display)
        opened.callback(display.close)
        made = LiveRig(camera, display, **options)
        opened.pop_all()
    return made


def pixels(folder: Path, tables: Tables) -> tuple[tuple[int, int], int]:
    """Projector's grid and number of channels, from the file of a virtual rig or as they are stated."""
    if tables.kind == "virtual":
        record = scene_of(folder, tables)
        return checks.grid("grid", _grid(folder, tables.rig, record)), len(_matrices(record))
    if tables.kind == "live":
        camera = _CAMERAS[tables.camera["kind"]]
        grid = checks.grid("display.grid", tables.display["grid"])
        return grid, tables.camera.get("channels", _parameters(camera)["channels"].default)
    channels = tables.rig.get("channels", _parameters(_RIGS[tables.kind][0])["channels"].default)
    return checks.grid("projector_grid", tables.rig["projector_grid"]), channels


def guessed(tables: Tables) -> tuple[NoiseModel, float | None]:
    """Noise as the tables tell it, and ambient light where they do."""
    if tables.kind not in ("virtual", "mitsuba"):
        return NoiseModel(levels=_levels("camera_bits", tables.rig.get("camera_bits"))), None
    told = {name: p.default for name, p in _parameters(_RIGS[tables.kind][0]).items()} | tables.rig
    electrons = _NOISELESS if told["gain"] is None else checks.number("gain", told["gain"], above=0.0)
    read = checks.number("read", told["read"], least=0.0)
    ambient = told.get("ambient")
    noise = NoiseModel(electrons=electrons, read=read, levels=_levels("bits", told["bits"]))
    return noise, None if ambient is None else float(np.mean(checks.real("ambient", ambient)))


def _levels(name: str, bits: Any) -> int:
    return 0 if bits in (None, "float") else 1 << checks.count(name, bits, least=8, most=16)


def scene_of(folder: Path, tables: Tables) -> Record | Parts:
    """The transport that a virtual rig photographs."""
    return formats.read(folder / str(tables.rig["transport"]))


def _matrices(record: Record | Parts) -> Any:
    return record.first_bounce if isinstance(record, Parts) else record.matrices


def _grid(folder: Path, options: dict[str, Any], record: Record | Parts) -> Any:
    grid = options.get("grid", record.grid)
    if grid is None:
        raise InputError(
            f"{folder / options['transport']} does not tell its grid; give grid = [h, w] beside it"
        )
    return grid


def _virtual(folder: Path, options: dict[str, Any]) -> VirtualRig:
    path = folder / str(options["transport"])
    record = formats.read(path)
    grid, through = _grid(folder, options, record), options.pop("camera_map", None)
    del options["transport"]
    options.pop("grid", None)
    if through is not None:
        seen = formats.read(folder / str(through))
        options["camera_map"] = _matrix(seen)[0]
    if isinstance(record, Parts):
        return VirtualRig(load(path, on_dark="mask"), grid, **options)
    if record.camera_grid is not None and through is None:
        options.setdefault("camera_grid", record.camera_grid)
    if record.mixing is not None:
        options.setdefault("mixing", record.mixing)
    T = _matrix(record)
    return VirtualRig(T if len(T) == 3 else T[0], grid, **options)


def _matrix(record: Record | Parts) -> tuple[Any, ...]:
    if isinstance(record, Parts):
        raise InputError("camera_map is a compressed transport; it must be a matrix")
    return record.in_memory().matrices


def _mitsuba(folder: Path, options: dict[str, Any]) -> MitsubaRig:
    scene, walls = options.pop("scene"), {name: options.pop(name) for name in _WALLS if name in options}
    if scene not in SCENES:
        if walls:
            raise InputError(f"{next(iter(walls))} is of {', '.join(SCENES)}; {scene!r} has its own")
        return MitsubaRig(folder / str(scene), **options)
    if walls:
        size = {"camera_grid": options.pop("camera_grid", None)}
        scene = mitsuba_scene(scene, options["projector_grid"], **walls, **size)
    return MitsubaRig(scene, **options)


def _camera(folder: Path, options: dict[str, Any]) -> Any:
    call = _CAMERAS[options.pop("kind")]
    source = options.get("source")
    if isinstance(source, str) and (folder / source).exists():  # else a stream
        options["source"] = folder / source
    return call(**options)
