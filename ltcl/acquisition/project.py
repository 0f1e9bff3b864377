# SPDX-License-Identifier: BSD-3-Clause
"""`Project`: an acquisition as a folder, whose acquisition.toml says what photographs, and how.

    [rig]
    kind = "virtual"            # virtual, mitsuba, folder or live
    transport = "truth.npz"     # file names are relative to the folder

    [acquire]
    strategy = "auto"

Keys of [rig] are arguments of its class, those of [acquire] of `ltcl.acquire`; "none" stands for
None. A virtual rig has the files `transport` and `camera_map`, a live one the tables [rig.camera],
of kind "opencv" or "gphoto2", and [rig.display].
"""

from __future__ import annotations

import contextlib
import inspect
import os
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import rigs
from ltcl.acquisition.calibrate import expected_exposures, expected_photographs
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.rigs.mitsuba import SCENES
from ltcl.acquisition.rigs.virtual import CURVES, Sensor
from ltcl.acquisition.scanning.plan import Light, measured
from ltcl.acquisition.settings import ScanSettings
from ltcl.errors import FileError, InputError, InputTypeError, LtclError
from ltcl.files import as_path, input_file
from ltcl.store import BlockStore, CompressedRecord, formats, load

FILE, STORE = "acquisition.toml", "transport.zarr"
_NOISELESS = 1e9  # electrons
_RIGS: dict[str, Any] = {"virtual": rigs.VirtualRig, "mitsuba": rigs.MitsubaRig}
_RIGS |= {"folder": rigs.FolderRig, "live": rigs.LiveRig}
_CAMERAS = {"opencv": rigs.OpenCVCamera, "gphoto2": rigs.GPhoto2Camera}
_OBJECTS = (
    "T",
    "folder",
    "rig",
    "store",
    "resume",
    "progress",
    "device",
)  # arguments that no file has


@dataclass(frozen=True)
class Project:
    """A folder with an acquisition.toml: the `table` of its rig, and `settings`, arguments of `ltcl.acquire`.

    Examples
    --------
    >>> import pathlib, tempfile, ltcl
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> ltcl.save(folder / "truth.npz", ltcl.scenes.dihedral(4).transport())
    >>> lines = (
    ...     "[rig]",
    ...     'kind = "virtual"',
    ...     'transport = "truth.npz"',
    ...     "[acquire]",
    ...     'geometry = "aligned"',
    ... )
    >>> _ = (folder / "acquisition.toml").write_text(chr(10).join(lines))
    >>> project = Project.open(folder)
    >>> with project.rig() as rig:
    ...     ltcl.acquire(rig, store=project.store, **project.settings).grid
    (4, 8)
    """

    folder: Path
    table: dict[str, Any]
    settings: dict[str, Any]

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Project:
        """Read and check the file of a folder: FileError where it is none, InputError for its keys."""
        path = (folder := as_path(folder)) / FILE
        if not path.exists():
            raise FileError(
                f"{path}: no such file; docs/guide/acquisition.md and 'ltcl simulate' show one"
            )
        try:
            content = tomllib.loads(input_file(path).read_text(encoding="utf-8-sig"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise FileError(f"{path}: is no TOML: {error}") from None
        for name, value in content.items():
            if name not in ("rig", "acquire") or not isinstance(value, dict):
                raise InputError(
                    f"{path}: has {name!r}; it must have the tables [rig] and [acquire] only"
                )
        table = _check(path, "rig", content.get("rig"), _RIGS)
        if table["kind"] == "live":
            table["camera"] = _check(path, "rig.camera", table["camera"], _CAMERAS)
            table["display"] = _check(path, "rig.display", table["display"], rigs.Display)
        settings = _check(path, "acquire", content.get("acquire", {}), ScanSettings)
        project = cls(folder, table, settings)
        if (name := settings.get("response")) is not None:
            with project.naming("acquire"):
                decode = CURVES[checks.one_of("response", name, CURVES)][1]
            settings["response"] = Response(decode(np.linspace(0.0, 1.0, 1025)))
        return project

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

    @contextlib.contextmanager
    def rig(self, *, closed: bool = False, aligned: bool = False) -> Iterator[Any]:
        """The rig, until the end of the block; a live one that is `closed` has its grid and channels only.

        What an `aligned` virtual rig photographs is seen on the pixels that its transport has.
        """
        camera = ("camera_map", "camera_grid") if aligned else ()
        with self.naming("rig"):
            try:
                rig = _make(
                    self.folder, {k: v for k, v in self.table.items() if k not in camera}, closed
                )
            except LtclError:
                raise
            except (TypeError, ValueError) as error:  # a number where a class expects a list
                raise InputTypeError(f"holds a value of an unusable type: {error}") from error
        with Shots(rig):
            yield rig

    @contextlib.contextmanager
    def naming(self, table: str) -> Iterator[None]:
        """Refusals of values begin with the file and the table that they stand in."""
        try:
            yield
        except FileError:  # begins with a file
            raise
        except (InputError, InputTypeError) as error:
            raise type(error)(f"{self.folder / FILE}: [{table}] {error}") from None

    def outlook(self) -> tuple[ScanSettings, dict[str, Any]]:
        """Settings as `acquire` checks them, and facts for `scanning.plan.plans`, measured or guessed."""
        with self.rig(closed=True) as rig:
            shots, light = Shots(rig), Light()
            with self.naming("acquire"):
                settings = ScanSettings(**self.settings).for_rig(shots)
            noise = NoiseModel(levels=1 << rig.bits if rig.bits else 0)
            if (sensor := getattr(rig, "sensor", None)) is not None:
                noise = replace(noise, electrons=sensor.gain or _NOISELESS, read=sensor.read)
            light = replace(light, ambient=float(np.mean(getattr(rig, "ambient", light.ambient))))
            times = expected_exposures(shots, light.direct + light.indirect, light.ambient)
            facts: dict[str, Any] = {"exposures": tuple(sorted(settings.exposures or times))}
            facts |= {
                "grid": shots.grid,
                "channels": shots.channels,
                "noise": noise,
                "light": light,
            }
        if self.state != "new":
            known = Calibration.of(self.store)
            facts |= {"exposures": known.exposures, "noise": known.noise, "light": measured(known)}
        ways = {"aligned": settings.geometry == "aligned", "by_hand": self.kind == "folder"}
        facts["calibration"] = expected_photographs(
            facts["grid"], facts["channels"], settings.frames, **ways
        )
        return settings, facts | {
            name: getattr(settings, name) for name in ("block", "order", "threshold")
        }


def _check(path: Path, name: str, table: Any, make: Any) -> dict[str, Any]:
    """The arguments of `make`, or of one of several by the key "kind", in a table; None for "none"."""
    if not isinstance(table, dict):
        raise InputError(f"{path}: has no table [{name}]; it must have one")
    needed: dict[str, bool] = {}
    if isinstance(make, dict):
        if (kind := table.get("kind")) not in [*make]:
            raise InputError(
                f"{path}: [{name}] kind is {kind!r}; it must be one of {', '.join(make)}"
            )
        make, needed = make[kind], {"kind": True}
    arguments = dict(inspect.signature(make).parameters)
    if arguments.pop("sensor", None):
        arguments |= inspect.signature(Sensor).parameters
    needed |= {key: a.default is a.empty for key, a in arguments.items() if key not in _OBJECTS}
    needed |= {"transport": True, "grid": False} if make is rigs.VirtualRig else {}
    for key in {**table, **needed}:
        if key not in needed:
            raise InputError(f"{path}: [{name}] has {key!r}; it may have {', '.join(needed)}")
        if needed[key] and key not in table:
            raise InputError(f"{path}: [{name}] has no {key!r}; it must be there")
    return {key: None if value == "none" else value for key, value in table.items()}


def _make(folder: Path, table: dict[str, Any], closed: bool) -> Any:
    kind = table.pop("kind")
    if kind == "virtual":
        T = load(folder / str(table.pop("transport")), grid=table.pop("grid", None), on_dark="mask")
        if (camera_map := table.get("camera_map")) is None:
            table.setdefault("camera_grid", T.camera_grid)
        else:
            record = formats.read(folder / str(camera_map))
            if isinstance(record, CompressedRecord):
                raise InputError(
                    f"camera_map is {camera_map}, a compressed transport; it must be a matrix"
                )
            table["camera_map"] = record.in_memory().matrices
        return rigs.VirtualRig(T, T.grid, **table)
    if kind == "mitsuba":
        scene = table.pop("scene")
        return rigs.MitsubaRig(scene if scene in SCENES else folder / str(scene), **table)
    if kind == "folder":
        return rigs.FolderRig(folder, **table)
    camera, display = dict(table.pop("camera")), table.pop("display")
    if closed:
        grid, channels = checks.grid("display.grid", display["grid"]), camera.get("channels", 3)
        return SimpleNamespace(projector_grid=grid, channels=channels, bits=None, photograph=None)
    source = camera.get("source")
    if isinstance(source, str) and (folder / source).exists():  # else a stream
        camera["source"] = folder / source
    with contextlib.ExitStack() as opened:
        eye = opened.enter_context(_CAMERAS[camera.pop("kind")](**camera))
        rig = rigs.LiveRig(eye, opened.enter_context(rigs.Display(**display)), **table)
        opened.pop_all()
    return rig
