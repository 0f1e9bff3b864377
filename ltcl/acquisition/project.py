# SPDX-License-Identifier: BSD-3-Clause
"""`Project`: an acquisition as a folder, whose acquisition.toml says what photographs, and how.

    [rig]
    kind = "virtual"            # virtual, mitsuba, folder or live
    transport = "truth.npz"     # file names are relative to the folder

    [acquire]
    strategy = "auto"

Keys of [rig] are the arguments of the class, with these in place of objects; those of [acquire] are the
arguments of `ltcl.acquire`; "none" stands for None.

    virtual    transport: a file; camera_map: a file, what each camera pixel sees (see `VirtualRig`)
    mitsuba    scene: dihedral, trihedral or box, which have albedo, baseline and depth; or a file
    folder     patterns and photographs lie in the folder of the acquisition
    live       [rig.camera] with kind "opencv" or "gphoto2", [rig.display]

The transport comes to transport.zarr in the folder. Nothing is opened before it is needed, least of all a
camera.
"""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import exposure, kept
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots
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
from ltcl.acquisition.rigs.mitsuba import SCENES
from ltcl.acquisition.rigs.sensor import CURVES, SimulatedRig
from ltcl.acquisition.scanning.plan import Light
from ltcl.acquisition.settings import Settings
from ltcl.acquisition.task import acquire
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.files import as_path, input_file
from ltcl.store import BlockStore, Parts, formats, load

logger = logging.getLogger(__name__)
FILE, STORE = "acquisition.toml", "transport.zarr"
_LARGEST = 1 << 20  # bytes of a file that somebody wrote by hand
_OURS = ("rig", "store", "resume", "progress", "device")  # of `acquire`, not for the file
_RETIRED = ("in_order", "scaling")  # keys of earlier versions
_NOISELESS = 1e9  # electrons


# What a table makes, its arguments that are not for a file, and keys that are no arguments.
_Kinds = dict[str, tuple[Callable[..., Any], tuple[str, ...], tuple[str, ...]]]
_RIGS: _Kinds = {
    "virtual": (VirtualRig, ("T", "grid"), ("transport", "grid")),
    "mitsuba": (MitsubaRig, (), ("albedo", "baseline", "depth")),
    "folder": (FolderRig, ("folder",), ()),
    "live": (LiveRig, ("camera", "display"), ()),
}
_CAMERAS: _Kinds = {"opencv": (OpenCVCamera, (), ()), "gphoto2": (GPhoto2Camera, (), ())}


@dataclass(frozen=True)
class Outlook:
    """What is known of a rig that was not opened; exposures, noise and light are guesses."""

    grid: tuple[int, int]
    channels: int
    exposures: tuple[float, ...]
    noise: NoiseModel
    light: Light


@dataclass(frozen=True)
class Project:
    """A folder with an acquisition.toml.

    Attributes
    ----------
    folder : Path
    table : dict
        Of the rig, its keys checked.
    settings : dict
        Keyword arguments of `ltcl.acquire`.

    Examples
    --------
    >>> import pathlib, tempfile, ltcl
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> ltcl.save(folder / "truth.npz", ltcl.scenes.dihedral(4).transport())
    >>> lines = ("[rig]", 'kind = "virtual"', 'transport = "truth.npz"', "[acquire]", 'geometry = "aligned"')
    >>> _ = (folder / "acquisition.toml").write_text(chr(10).join(lines))
    >>> project = Project.open(folder)
    >>> with project.rig() as rig:
    ...     T = ltcl.acquire(rig, store=project.store, **project.settings)
    >>> T.grid
    (4, 8)
    """

    folder: Path
    table: dict[str, Any]
    settings: dict[str, Any]

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Project:
        """Read and check the file of a folder; no rig is made.

        FileError where there is none, or no TOML; InputError for unknown or missing tables and keys.
        """
        folder = as_path(folder)
        if folder.exists() and not folder.is_dir():
            raise FileError(f"{folder}: is a file; an acquisition is a folder with an {FILE}")
        path = folder / FILE
        content = _parse(path)
        for name, value in content.items():
            if name not in ("rig", "acquire") or not isinstance(value, dict):
                raise InputError(f"{path}: has {name!r}; it must have the tables [rig] and [acquire] only")
        if "rig" not in content:
            raise InputError(f"{path}: has no table [rig]; it must say with what to photograph")
        table = _check_rig(path, content["rig"])
        settings = _check_keys(path, "acquire", content.get("acquire", {}), acquire, _OURS)
        if (name := settings.get("response")) is not None:
            if not isinstance(name, str) or name not in CURVES:
                known = ", ".join(CURVES)
                raise InputError(f"{path}: [acquire] response is {name!r}; it must be {known}, or left out")
            settings["response"] = Response(CURVES[name].decode(np.linspace(0.0, 1.0, 1025)))
        if not isinstance(settings.get("exposures", []), (list, NoneType)):
            value = settings["exposures"]
            raise InputTypeError(f"{path}: [acquire] exposures is {value!r}; it must be a list")
        return cls(folder, table, settings)

    @property
    def path(self) -> Path:
        """The acquisition.toml."""
        return self.folder / FILE

    @property
    def store(self) -> Path:
        """Where the transport comes to."""
        return self.folder / STORE

    @property
    def kind(self) -> str:
        """Of the rig."""
        return self.table["kind"]

    @property
    def state(self) -> str:
        """Of the store: "new" until a whole calibration is in it, then "begun", at last "final"."""
        if not self.store.exists():
            return "new"
        store = BlockStore.open(self.store)
        return "final" if store.final else "begun" if "strategy" in store.attributes else "new"

    @property
    def kept(self) -> int:
        """Photographs that a calibration which has not ended can go on with; those of a folder rig apart."""
        return kept.count(self.store)

    @contextlib.contextmanager
    def rig(self) -> Iterator[Any]:
        """The rig, which is closed at the end.

        InputError and InputTypeError name the table and the value; FileError a file that the rig needs;
        AcquisitionError a camera, a display or a package that is not there.
        """
        with self.naming("rig"):
            try:
                rig = _make(self.folder, dict(self.table))
            except LtclError:
                raise
            except (TypeError, ValueError) as error:  # a number where a class expects a list
                raise InputTypeError(f"holds a value of an unusable type: {error}") from error
        with Shots(rig):
            yield rig

    @contextlib.contextmanager
    def described(self) -> Iterator[Any]:
        """A rig for what is photographed already: that of `rig`, but no camera or display is opened."""
        if self.kind != "live":
            with self.rig() as rig:
                yield rig
            return
        with self.naming("rig"):
            grid = checks.grid("display.grid", self.table["display"]["grid"])
        yield _Unopened(grid, self.table["camera"].get("channels", 3))

    def aligned(self) -> Project:
        """The same, but what a virtual rig photographs is seen on the pixels that its transport has."""
        table = {k: v for k, v in self.table.items() if k not in ("camera_map", "camera_grid")}
        return replace(self, table=table)

    @contextlib.contextmanager
    def naming(self, table: str) -> Iterator[None]:
        """Refusals of values begin with the file and the table that they stand in."""
        try:
            yield
        except FileError:  # begins with a file
            raise
        except (InputError, InputTypeError) as error:
            raise type(error)(f"{self.path}: [{table}] {error}") from None

    def check(self) -> Settings:
        """What `acquire` would refuse before the first photograph; errors as there. No camera is opened."""
        defaults = {n: p.default for n, p in inspect.signature(acquire).parameters.items() if n not in _OURS}
        with self.described() as rig, self.naming("acquire"):
            return Settings.of(Shots(rig), **(defaults | self.settings))

    def outlook(self) -> Outlook:
        """Pixels, channels and guesses of the rest, for a plan before the first photograph.

        The scene is assumed to be as `Light` is; exposures are chosen for it as those of a scan are.
        """
        with self.described() as rig, self.naming("acquire"):
            shots, facts, light = Shots(rig), getattr(rig, "describe", dict)(), Light()
            bits = facts.get("camera_bits", facts.get("bits"))
            noise = NoiseModel(levels=1 << bits if isinstance(bits, int) else 0)
            if "gain" in facts:
                noise = replace(noise, electrons=facts["gain"] or _NOISELESS, read=facts["read"])
            if "ambient" in facts:
                light = Light(ambient=float(np.mean(facts["ambient"])))
            exposures = self.settings.get("exposures")
            if exposures is None:
                exposures = exposure.expected(shots, light.direct + light.indirect, light.ambient)
            return Outlook(shots.grid, shots.channels, tuple(sorted(map(float, exposures))), noise, light)


@dataclass(frozen=True)
class _Unopened:
    """A live rig that takes no photographs."""

    projector_grid: tuple[int, int]
    channels: int

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        raise AcquisitionError("a rig that was not opened takes no photographs")


def _parse(path: Path) -> dict[str, Any]:
    if not path.exists():
        kinds = ", ".join(_RIGS)
        raise FileError(f"{path}: no such file; 'ltcl simulate' makes one; or write [rig], kind = {kinds}")
    if input_file(path).stat().st_size > _LARGEST:
        raise FileError(f"{path}: has {checks.size(path.stat().st_size)}; it must be a short text")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileError(f"{path}: is no TOML: {error}") from None


def _check_rig(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    parts = ("camera", "display") if table.get("kind") == "live" else ()
    rig = _check_kind(path, "rig", {k: v for k, v in table.items() if k not in parts}, _RIGS)
    if rig["kind"] == "virtual" and "transport" not in rig:
        raise InputError(f"{path}: [rig] has no 'transport'; it must be the file of one")
    for name in parts:
        if not isinstance(part := table.get(name), dict):
            raise InputError(f"{path}: has no table [rig.{name}]; a live rig has a camera and a display")
        if name == "camera":
            rig[name] = _check_kind(path, "rig.camera", part, _CAMERAS)
        else:
            rig[name] = _check_keys(path, "rig.display", part, Display)
    return rig


def _check_kind(path: Path, table: str, values: dict[str, Any], kinds: _Kinds) -> dict[str, Any]:
    kind = values.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        raise InputError(f"{path}: [{table}] kind is {kind!r}; it must be one of {', '.join(kinds)}")
    options = {key: value for key, value in values.items() if key != "kind"}
    return {"kind": kind, **_check_keys(path, table, options, *kinds[kind])}


def _check_keys(
    path: Path,
    table: str,
    values: dict[str, Any],
    make: Callable[..., Any],
    hidden: tuple[str, ...] = (),
    others: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Refuse unknown keys and miss those that are needed; the values, with None for "none"."""
    parameters = dict(inspect.signature(make).parameters)
    if parameters.pop("sensor", None) is not None:
        sensor = inspect.signature(SimulatedRig).parameters
        parameters |= {name: p for name, p in sensor.items() if p.kind is p.KEYWORD_ONLY}
    parameters = {name: p for name, p in parameters.items() if name not in hidden}
    known = [*others, *parameters]
    for key in values:
        if key in _RETIRED:
            logger.warning("%s: [%s] %s has no effect any more", path, table, key)
        elif key not in known:
            raise InputError(f"{path}: [{table}] has {key!r}; it may have {', '.join(known)}")
    for key, parameter in parameters.items():
        if parameter.default is parameter.empty and key not in values:
            raise InputError(f"{path}: [{table}] has no {key!r}; it must be there")
    return {k: None if v == "none" else v for k, v in values.items() if k not in _RETIRED}


def _make(folder: Path, table: dict[str, Any]) -> Any:
    kind = table.pop("kind")
    if kind == "virtual":
        return _virtual(folder, table)
    if kind == "mitsuba":
        scene = table.pop("scene")
        walls = {name: table.pop(name) for name in ("albedo", "baseline", "depth") if name in table}
        if scene not in SCENES:
            if walls:
                raise InputError(f"{next(iter(walls))} is of {', '.join(SCENES)}; {scene!r} has its own")
            scene = folder / str(scene)
        elif walls:
            walls["camera_grid"] = table.pop("camera_grid", None)
            scene = mitsuba_scene(scene, table["projector_grid"], **walls)
        return MitsubaRig(scene, **table)
    if kind == "folder":
        return FolderRig(folder, **table)
    camera, display = dict(table.pop("camera")), table.pop("display")
    source = camera.get("source")
    if isinstance(source, str) and (folder / source).exists():  # else a stream
        camera["source"] = folder / source
    with contextlib.ExitStack() as opened:
        eye = opened.enter_context(_CAMERAS[camera.pop("kind")][0](**camera))
        rig = LiveRig(eye, opened.enter_context(Display(**display)), **table)
        opened.pop_all()
    return rig


def _virtual(folder: Path, table: dict[str, Any]) -> VirtualRig:
    path = folder / str(table.pop("transport"))
    record, camera_map = formats.read(path), table.pop("camera_map", None)
    grid = table.pop("grid", record.grid)
    if grid is None:
        raise InputError(f"{path} has no grid; add grid = [h, w]")
    if camera_map is not None:
        C = formats.read(folder / str(camera_map))
        if isinstance(C, Parts):
            raise InputError("camera_map is a compressed transport; it must be a matrix")
        (table["camera_map"],) = C.in_memory().matrices
    if isinstance(record, Parts):
        return VirtualRig(load(path, on_dark="mask"), grid, **table)
    if record.camera_grid is not None and camera_map is None:
        table.setdefault("camera_grid", record.camera_grid)
    if record.mixing is not None:
        table.setdefault("mixing", record.mixing)
    T = record.in_memory().matrices
    return VirtualRig(T if len(T) == 3 else T[0], grid, **table)
