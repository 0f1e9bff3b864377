# SPDX-License-Identifier: BSD-3-Clause
"""`Project`: an acquisition as a folder, whose acquisition.toml says what photographs, and how.

    [rig]
    kind = "virtual"            # virtual, mitsuba, folder or live
    transport = "truth.npz"     # file names are relative to the folder

    [acquire]
    strategy = "auto"

Keys are the arguments of `VirtualRig` and the other rigs (`project_rigs` makes them), and of `ltcl.acquire`;
"none" stands for None. The transport comes to transport.zarr beside it, and a folder rig keeps its patterns
and photographs there, too. Nothing is opened before it is asked for, least of all a camera.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import exposing, kept, project_rigs
from ltcl.acquisition.project_rigs import Tables
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.rigs import curves
from ltcl.acquisition.scanning.plan import Light
from ltcl.acquisition.settings import Settings
from ltcl.acquisition.task import acquire
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.files import as_path, input_file
from ltcl.store import BlockStore

FILE, STORE = "acquisition.toml", "transport.zarr"
_CAMERA = ("camera_map", "camera_grid")
_LARGEST = 1 << 20  # bytes of a file that somebody wrote by hand
_OURS = ("rig", "store", "resume", "progress", "device")  # of `acquire`, not for the file


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
    tables : Tables
        Of the rig, checked by name.
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
    tables: Tables
    settings: dict[str, Any]

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Project:
        """Read and check the file of a folder; no rig is made.

        Raises
        ------
        FileError
            There is none, or it is no TOML.
        InputError
            A table or a key that is unknown, or one that is missing.
        """
        folder = as_path(folder)
        if folder.exists() and not folder.is_dir():
            raise FileError(f"{folder}: is a file; an acquisition is a folder with an {FILE}")
        path = folder / FILE
        found = _parsed(path)
        for name, value in found.items():
            if name not in ("rig", "acquire") or not isinstance(value, dict):
                raise InputError(f"{path}: has {name!r}; it must have the tables [rig] and [acquire] only")
        if "rig" not in found:
            raise InputError(f"{path}: has no table [rig]; it must say with what to photograph")
        tables = project_rigs.check(path, found["rig"])
        given = project_rigs.without_none(found.get("acquire", {}))
        project_rigs.check_keys(path, "acquire", given, acquire, _OURS)
        if "response" in given:
            given["response"] = _response(path, given["response"])
        if not isinstance(given.get("exposures", []), (list, NoneType)):
            raise InputTypeError(f"{path}: [acquire] exposures is {given['exposures']!r}; it must be a list")
        return cls(folder, tables, given)

    @property
    def path(self) -> Path:
        """The file that says it all."""
        return self.folder / FILE

    @property
    def store(self) -> Path:
        """Where the transport comes to."""
        return self.folder / STORE

    @property
    def kind(self) -> str:
        """Of the rig."""
        return self.tables.kind

    @property
    def state(self) -> str:
        """Of the store: "new" until a whole calibration is in it, then "begun", at last "final"."""
        if not self.store.exists():
            return "new"
        found = BlockStore.open(self.store)
        return "final" if found.final else "begun" if "strategy" in found.attributes else "new"

    @property
    def kept(self) -> int:
        """Photographs that a calibration which has not ended can go on with; those of a folder rig apart."""
        return kept.count(self.store)

    @property
    def next(self) -> str:
        """The command that photographs what is missing."""
        how = "run" if self.state == "new" and not self.kept else "resume"
        return f"'ltcl acquire {how} {self.folder}'"

    @contextlib.contextmanager
    def rig(self) -> Iterator[Any]:
        """The rig, which is closed at the end.

        Raises
        ------
        InputError, InputTypeError
            A value in the file that the rig refuses.
        FileError, AcquisitionError
            A file that the rig needs; a camera, a display or a package that is not there.
        """
        with self.naming("rig"):
            try:
                made = project_rigs.make(self.folder, self.tables)
            except LtclError:
                raise
            except (TypeError, ValueError) as error:  # where a class takes what it is given for a list
                raise InputTypeError(f"holds a value of an unusable type: {error}") from error
        with Shots(made):
            yield made

    @contextlib.contextmanager
    def described(self) -> Iterator[Any]:
        """A rig for what is photographed already: that of `rig`, but no camera or display is opened."""
        if self.kind != "live":
            with self.rig() as made:
                yield made
            return
        with self.naming("rig"):
            grid, channels = project_rigs.pixels(self.folder, self.tables)
        yield _Unseen(grid, channels, None)

    def aligned(self) -> Project:
        """The same, but what a virtual rig photographs is seen on the pixels that its transport has."""
        kept = {key: value for key, value in self.tables.rig.items() if key not in _CAMERA}
        return replace(self, tables=replace(self.tables, rig=kept))

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
        """What `acquire` would refuse before the first photograph; no camera is opened.

        Raises
        ------
        InputError, InputTypeError, FileError, AcquisitionError
            As `rig` and `ltcl.acquire`.
        """
        given = {name: p.default for name, p in inspect.signature(acquire).parameters.items()}
        given = {name: value for name, value in given.items() if name not in _OURS} | self.settings
        with self.described() as rig, self.naming("acquire"):
            return Settings.of(Shots(rig), **given)

    def outlook(self) -> Outlook:
        """Pixels, channels and guesses of the rest, for a plan before the first photograph.

        The scene is taken to be as `Light` is; exposures are chosen for it as those of a scan are.

        Raises
        ------
        InputError, FileError
            As `rig`, as far as they are needed for it.
        """
        with self.naming("rig"):
            grid, channels = project_rigs.pixels(self.folder, self.tables)
            noise, ambient = project_rigs.guessed(self.tables)
        light = Light() if ambient is None else Light(ambient=ambient)
        with self.naming("acquire"):
            exposures = self._exposures(grid, channels, noise, light)
        return Outlook(grid, channels, exposures, noise, light)

    def _exposures(
        self, grid: tuple[int, int], channels: int, noise: NoiseModel, light: Light
    ) -> tuple[float, ...]:
        given = self.settings.get("exposures")
        if given is not None:
            return tuple(sorted(float(t) for t in given))
        unseen: Any = _Unseen(grid, channels, self.tables.rig.get("exposures"))
        white, deep = exposing.guess(light.direct + light.indirect, light.ambient)
        return exposing.for_scan(Shots(unseen), white, deep, noise)


@dataclass(frozen=True)
class _Unseen:
    """A rig that offers exposures and takes no photographs."""

    projector_grid: tuple[int, int]
    channels: int
    exposures: Any

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        raise AcquisitionError("no photographs are taken by a rig that was not opened")


def _parsed(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise FileError(
            f"{path}: no such file; 'ltcl simulate' makes one, or write one with [rig] and its kind: "
            "virtual, mitsuba, folder or live"
        )
    if input_file(path).stat().st_size > _LARGEST:
        raise FileError(f"{path}: has {checks.size(path.stat().st_size)}; it must be a short text")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileError(f"{path}: is no TOML: {error}") from None


def _response(path: Path, name: Any) -> Response | None:
    """The camera's, where it is known by name."""
    if name is None:
        return None
    if not isinstance(name, str) or name not in curves.NAMED:
        known = ", ".join(curves.NAMED)
        raise InputError(f"{path}: [acquire] response is {name!r}; it must be {known}, or left out")
    return Response(curves.NAMED[name].decode(np.linspace(0.0, 1.0, 1025)))
