# SPDX-License-Identifier: BSD-3-Clause
"""`Project`: an acquisition as a folder, with an acquisition.toml that describes rig and scan.

    [rig]
    kind = "virtual"            # virtual, mitsuba, folder or live
    transport = "truth.npz"     # file names are relative to the folder

    [acquire]
    strategy = "auto"

Keys of [rig] are arguments of its class, those of [acquire] of `ScanSettings`; "none" stands for
None. A virtual rig has the files `transport` and `camera_map`, a live one the tables [rig.camera],
of kind "opencv" or "gphoto2", and [rig.display].

Several projectors are tables [[projector]], each with a `name` and the keys of [rig] that are its
own; [rig] has those that all have in common, and [scene] the `side` of the pixels of T in camera
pixels. Each is a `Project` of its own with the same folder.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import rigs
from ltcl.acquisition.calibration import Calibration, is_calibrated
from ltcl.acquisition.metering import expected_exposures
from ltcl.acquisition.project_file import (
    CAMERAS,
    check_rig,
    check_side,
    check_table,
    check_tables,
    projector_tables,
    read_toml,
    settings_of_several,
)
from ltcl.acquisition.projectors import (
    ProjectorView,
    Warp,
    WarpedRig,
    camera_geometry,
    read_view,
)
from ltcl.acquisition.projectors.combined import MAP_SUFFIX
from ltcl.acquisition.projectors.warp import default_side, scene_grid
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import RigError, Shots
from ltcl.acquisition.rigs.mitsuba import SCENES
from ltcl.acquisition.rigs.simulated import CURVES, Sensor
from ltcl.acquisition.scanning.plan import Light, measured
from ltcl.acquisition.settings import ScanSettings
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.files import as_path
from ltcl.store import BlockStore, StoreRecord, formats, load

FILE = "acquisition.toml"
STORE = "transport.zarr"
# Electrons at full scale of a camera without photon noise.
NOISELESS_ELECTRONS = 1e9
# Codes at which the curve of a known response is tabulated.
RESPONSE_CODES = 1025


@dataclass(frozen=True, kw_only=True)
class ClosedRig:
    """Grid and channels of a live rig whose camera and display are not opened: for plans only."""

    projector_grid: tuple[int, int]
    channels: int

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Raise AcquisitionError: the camera is not open."""
        raise AcquisitionError("the camera of the rig is not open")


@dataclass(frozen=True)
class Project:
    """A folder with an acquisition.toml.

    Attributes
    ----------
    folder : Path
    table : dict
        The table [rig].
    settings : dict
        The table [acquire], arguments of `ltcl.acquire` and fields of `ScanSettings`.
    name : str
        Of one of several projectors; else empty.
    side : int, optional
        Camera pixels along a side of a pixel of T, for several projectors; None: chosen.

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
    name: str = ""
    side: int | None = None

    @classmethod
    def open(cls, folder: str | os.PathLike[str], projector: str | None = None) -> Project:
        """Read and check the file of a folder; with several projectors take one by its name.

        FileError if the folder has none, or it is not valid TOML; InputError for its keys, and for
        a projector that is needed and not named, or is not there.
        """
        projects = cls.open_all(folder)
        path = as_path(folder) / FILE
        names = [project.name for project in projects]
        if projector is None and len(projects) > 1:
            raise InputError(
                f"{path}: has the projectors {', '.join(names)}; name one (--projector NAME), or "
                "make one transport of all with 'ltcl combine'"
            )
        for project in projects:
            if projector in (None, project.name):
                return project
        has = "has no [[projector]]"
        if names[0]:
            has = f"has the projectors {', '.join(names)}"
        raise InputError(f"projector is {projector!r}; {path} {has}")

    @classmethod
    def open_all(cls, folder: str | os.PathLike[str]) -> tuple[Project, ...]:
        """Read and check the file of a folder: one project, or one for each projector.

        Errors are those of `open`.
        """
        folder = as_path(folder)
        path = folder / FILE
        content = read_toml(path)
        check_tables(path, content)
        settings = content.get("acquire", {})
        settings = check_table(path, "acquire", settings, ScanSettings)
        if "projector" not in content:
            if "scene" in content:
                raise InputError(f"{path}: has [scene], but no [[projector]], whose T it is about")
            projects = [cls(folder, check_rig(path, "rig", content.get("rig")), settings)]
        else:
            settings = settings_of_several(path, settings)
            side = check_side(path, content.get("scene", {}))
            projects = []
            for name, table in projector_tables(path, content).items():
                rig = check_rig(path, f"projector {name}", table)
                projects.append(cls(folder, rig, settings, name, side))
        curve = settings.get("response")
        if curve is not None:
            with projects[0].naming("acquire"):
                settings["response"] = _known_response(curve)
        return tuple(projects)

    @property
    def store(self) -> Path:
        """Folder of the transport."""
        return self.folder / (f"{self.name}.zarr" if self.name else STORE)

    @property
    def view_path(self) -> Path:
        """File of the map of one of several projectors."""
        return self.folder / f"{self.name}{MAP_SUFFIX}"

    @property
    def check_path(self) -> Path:
        """File that says that the camera did not move before the scan of this projector."""
        return self.folder / f"{self.name}.check.json"

    @property
    def rig_folder(self) -> Path:
        """Folder of the patterns and photographs of a folder rig."""
        return self.folder / self.name if self.name else self.folder

    def view(self) -> ProjectorView | None:
        """The map of one of several projectors; None before it is measured."""
        return read_view(self.view_path) if self.view_path.exists() else None

    def scan_side(self, camera_grid: tuple[int, int]) -> int:
        """Camera pixels along a side of a pixel of T."""
        return default_side(camera_grid) if self.side is None else self.side

    def scan_settings(self, camera_grid: tuple[int, int]) -> dict[str, Any]:
        """Arguments of `ltcl.acquire`: those of the file, and the geometry of several projectors.

        All have the pixels of T, of `scan_side`, in common.
        """
        if not self.name:
            return self.settings
        with self.naming("scene"):
            geometry = camera_geometry(camera_grid, self.scan_side(camera_grid))
        return {**self.settings, "geometry": geometry}

    @property
    def kind(self) -> str:
        """Kind of the rig."""
        return self.table["kind"]

    @property
    def state(self) -> str:
        """State of the store.

        "new" until a whole calibration is in it, then "begun", at last "final".
        """
        if not self.store.exists():
            return "new"
        store = BlockStore.open(self.store)
        if store.final:
            return "final"
        return "begun" if is_calibrated(store) else "new"

    @contextlib.contextmanager
    def rig(
        self,
        *,
        closed: bool = False,
        aligned: bool = False,
        photographs: Path | None = None,
        own_pixels: bool = False,
    ) -> Iterator[Any]:
        """The rig, which is closed at the end of the block.

        Parameters
        ----------
        closed : bool
            Open no camera and no display: a live rig then has its grid and channels only.
        aligned : bool
            Photograph a virtual rig on the pixels that its transport has.
        photographs : Path, optional
            Folder of patterns and photographs of a folder rig, instead of that of the acquisition.
        own_pixels : bool
            Take patterns on the projector's own pixels; else one of several projectors, whose map
            is measured, takes those on the pixels of T.
        """
        table = dict(self.table)
        view = None if own_pixels or not self.name else self.view()
        if aligned and view is None:
            table.pop("camera_map", None)
            table.pop("camera_grid", None)
        with self.naming("rig"):
            try:
                if self.kind == "folder":
                    place = self.rig_folder if photographs is None else photographs
                    rig = _make_rig(place, table, closed)
                else:
                    rig = _make_rig(self.folder, table, closed)
            except LtclError:
                raise
            except (TypeError, ValueError) as error:
                # A number where a class expects a list.
                raise InputTypeError(f"holds a value of an unusable type: {error}") from error
        with contextlib.ExitStack() as opened:
            if hasattr(rig, "close"):
                opened.callback(rig.close)
            if view is None:
                yield rig
                return
            with self.naming("scene"):
                warp = Warp.of(view.mapping, self.scan_side(view.mapping.camera_grid))
            yield WarpedRig(rig, warp)

    @contextlib.contextmanager
    def naming(self, table: str) -> Iterator[None]:
        """Begin refusals of values with the file and the table that they stand in.

        A `RigError` is about [rig], whatever the table; so is all about [rig] about [[projector]],
        where there are several.
        """
        of_rig = f"projector {self.name}" if self.name else "rig"
        if table == "rig":
            table = of_rig
        try:
            yield
        except FileError:
            # It begins with a file.
            raise
        except RigError as error:
            raise RigError(f"{self.folder / FILE}: [{of_rig}] {error}") from None
        except (InputError, InputTypeError) as error:
            raise type(error)(f"{self.folder / FILE}: [{table}] {error}") from None

    def outlook(self) -> tuple[ScanSettings, dict[str, Any]]:
        """Settings as `acquire` checks them, and arguments of `scanning.plans`.

        Noise, light and exposures are guessed, or measured if the store has a calibration.
        """
        with self.rig(closed=True) as rig:
            shots = Shots(rig)
            camera_grid = known_camera_grid(rig)
            arguments = self.settings
            if self.name and camera_grid is not None:
                arguments = self.scan_settings(camera_grid)
            with self.naming("acquire"):
                settings = ScanSettings(**arguments).for_rig(shots)
            noise = _expected_noise(rig)
            light = _expected_light(rig)
            exposures = settings.exposures
            if exposures is None:
                lit = light.direct + light.indirect
                exposures = expected_exposures(shots, lit, light.ambient)
        if self.state != "new":
            calibration = Calibration.of(self.store)
            noise = calibration.noise
            light = measured(calibration)
            exposures = calibration.exposures
            camera_grid = calibration.resampling.camera_grid
        grid = shots.grid
        if self.name:
            grid = self._grid_of_several(camera_grid)
        megapixels = None
        if camera_grid is not None:
            megapixels = math.prod(camera_grid) / 1e6
        facts = {
            "grid": grid,
            "channels": shots.channels,
            "exposures": tuple(sorted(exposures)),
            "noise": noise,
            "light": light,
            "frames": settings.frames,
            # A map that is there takes no photographs either.
            "aligned": settings.geometry != "graycode",
            "by_hand": self.kind == "folder",
            "fixed_exposures": settings.exposures is not None or self.state != "new",
            "block": settings.block,
            "order": settings.order,
            "threshold": settings.threshold,
            "megapixels": megapixels,
        }
        return settings, facts

    def _grid_of_several(self, camera_grid: tuple[int, int] | None) -> tuple[int, int]:
        """Height and width of T on the pixels that several projectors share."""
        view = self.view()
        if view is not None:
            camera_grid = view.mapping.camera_grid
        if camera_grid is None:
            raise InputError(
                f"{self.folder / FILE}: [projector {self.name}] its photographs have a size that "
                "is not known yet; 'ltcl acquire run' begins with some of Gray code, which tell it"
            )
        with self.naming("scene"):
            return scene_grid(camera_grid, self.scan_side(camera_grid))


def _known_response(curve: Any) -> Response:
    """The response of a named curve."""
    checks.one_of("response", curve, CURVES)
    _, decode = CURVES[curve]
    return Response(decode(np.linspace(0.0, 1.0, RESPONSE_CODES)))


def known_camera_grid(rig: Any) -> tuple[int, int] | None:
    """(H, W) of the photographs of a rig, if it tells, or if a folder has one; else None."""
    if isinstance(getattr(rig, "rig", rig), rigs.FolderRig):
        return rig.photographed_grid()
    return getattr(rig, "camera_grid", None)


def _expected_noise(rig: Any) -> NoiseModel:
    """Noise of the camera of a rig, as far as it is known before the calibration."""
    bits = getattr(rig, "bits", None)
    levels = 1 << bits if bits else 0
    sensor: Sensor | None = getattr(rig, "sensor", None)
    if sensor is None:
        return NoiseModel(levels=levels)
    electrons = sensor.gain
    if electrons is None:
        electrons = NOISELESS_ELECTRONS
    return NoiseModel(levels=levels, electrons=electrons, read=sensor.read)


def _expected_light(rig: Any) -> Light:
    """Light of a scene, as far as it is known before the calibration."""
    ambient = getattr(rig, "ambient", None)
    if ambient is None:
        return Light()
    return Light(ambient=float(np.mean(ambient)))


def _make_rig(folder: Path, table: dict[str, Any], closed: bool) -> Any:
    """Make the rig of a table; a live one that is `closed` opens nothing."""
    options = dict(table)
    kind = options.pop("kind")
    if kind == "virtual":
        return _make_virtual_rig(folder, options)
    if kind == "mitsuba":
        scene = options.pop("scene")
        if scene not in SCENES:
            scene = folder / str(scene)
        return rigs.MitsubaRig(scene, **options)
    if kind == "folder":
        return rigs.FolderRig(folder, **options)
    if closed:
        grid = checks.grid("display.grid", options["display"]["grid"])
        channels = options["camera"].get("channels", 3)
        return ClosedRig(projector_grid=grid, channels=channels)
    return _make_live_rig(folder, options)


def _make_virtual_rig(folder: Path, options: dict[str, Any]) -> rigs.VirtualRig:
    """Make a rig of the files `transport` and `camera_map`."""
    path = folder / str(options.pop("transport"))
    T = load(path, grid=options.pop("grid", None), on_dark="mask")
    camera_map = options.get("camera_map")
    if camera_map is None:
        options.setdefault("camera_grid", T.camera_grid)
    else:
        record = formats.read(folder / str(camera_map))
        if not isinstance(record, StoreRecord):
            raise InputError(
                f"camera_map is {camera_map}, a transport of operators; it must be a matrix"
            )
        options["camera_map"] = record.in_memory().matrices
    return rigs.VirtualRig(T, T.grid, **options)


def _make_live_rig(folder: Path, options: dict[str, Any]) -> rigs.LiveRig:
    """Open the camera and the display of a live rig; both are closed again if one fails."""
    camera_options = dict(options.pop("camera"))
    display_options = options.pop("display")
    source = camera_options.get("source")
    # A text that names no file is a stream.
    if isinstance(source, str) and (folder / source).exists():
        camera_options["source"] = folder / source
    camera_class = CAMERAS[camera_options.pop("kind")]
    with contextlib.ExitStack() as opened:
        camera = opened.enter_context(camera_class(**camera_options))
        display = opened.enter_context(rigs.Display(**display_options))
        rig = rigs.LiveRig(camera, display, **options)
        opened.pop_all()
    return rig
