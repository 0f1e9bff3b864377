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
"""

from __future__ import annotations

import contextlib
import inspect
import math
import os
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import rigs
from ltcl.acquisition.calibration import Calibration, is_calibrated
from ltcl.acquisition.metering import expected_exposures
from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.acquisition.rig import RigError, Shots
from ltcl.acquisition.rigs.mitsuba import SCENES
from ltcl.acquisition.rigs.simulated import CURVES, Sensor
from ltcl.acquisition.scanning.plan import Light, measured
from ltcl.acquisition.settings import ScanSettings
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, LtclError
from ltcl.files import as_path, input_file
from ltcl.store import BlockStore, StoreRecord, formats, load

FILE = "acquisition.toml"
STORE = "transport.zarr"
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
        """Read and check the file of a folder.

        FileError if the folder has none, or it is not valid TOML; InputError for its keys.
        """
        folder = as_path(folder)
        path = folder / FILE
        content = _read_toml(path)
        for name, value in content.items():
            if name not in ("rig", "acquire") or not isinstance(value, dict):
                raise InputError(
                    f"{path}: has {name!r}; it must have the tables [rig] and [acquire] only"
                )
        table = _check_kind(path, "rig", content.get("rig"), RIGS)
        if table["kind"] == "live":
            camera = table["camera"]
            display = table["display"]
            table["camera"] = _check_kind(path, "rig.camera", camera, CAMERAS)
            table["display"] = _check_table(path, "rig.display", display, rigs.Display)
        settings = content.get("acquire", {})
        settings = _check_table(path, "acquire", settings, ScanSettings)
        project = cls(folder, table, settings)
        curve = settings.get("response")
        if curve is not None:
            with project.naming("acquire"):
                settings["response"] = _known_response(curve)
        return project

    @property
    def store(self) -> Path:
        """Folder of the transport."""
        return self.folder / STORE

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
        self, *, closed: bool = False, aligned: bool = False, photographs: Path | None = None
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
        """
        table = dict(self.table)
        if aligned:
            table.pop("camera_map", None)
            table.pop("camera_grid", None)
        with self.naming("rig"):
            try:
                if self.kind == "folder" and photographs is not None:
                    rig = _make_rig(photographs, table, closed)
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
            yield rig

    @contextlib.contextmanager
    def naming(self, table: str) -> Iterator[None]:
        """Begin refusals of values with the file and the table that they stand in.

        A `RigError` is about [rig], whatever the table.
        """
        try:
            yield
        except FileError:
            # It begins with a file.
            raise
        except RigError as error:
            raise RigError(f"{self.folder / FILE}: [rig] {error}") from None
        except (InputError, InputTypeError) as error:
            raise type(error)(f"{self.folder / FILE}: [{table}] {error}") from None

    def outlook(self) -> tuple[ScanSettings, dict[str, Any]]:
        """Settings as `acquire` checks them, and arguments of `scanning.plans`.

        Noise, light and exposures are guessed, or measured if the store has a calibration.
        """
        with self.rig(closed=True) as rig:
            shots = Shots(rig)
            with self.naming("acquire"):
                settings = ScanSettings(**self.settings).for_rig(shots)
            camera_grid = known_camera_grid(rig)
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
        megapixels = None
        if camera_grid is not None:
            megapixels = math.prod(camera_grid) / 1e6
        facts = {
            "grid": shots.grid,
            "channels": shots.channels,
            "exposures": tuple(sorted(exposures)),
            "noise": noise,
            "light": light,
            "frames": settings.frames,
            "aligned": settings.geometry == "aligned",
            "by_hand": self.kind == "folder",
            "fixed_exposures": settings.exposures is not None or self.state != "new",
            "block": settings.block,
            "order": settings.order,
            "threshold": settings.threshold,
            "megapixels": megapixels,
        }
        return settings, facts


def _read_toml(path: Path) -> dict[str, Any]:
    if not path.exists():
        raise FileError(
            f"{path}: no such file; docs/guide/acquisition.md and 'ltcl simulate' show one"
        )
    try:
        text = input_file(path).read_text(encoding="utf-8-sig")
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileError(f"{path}: is not valid TOML: {error}") from None


def _known_response(curve: Any) -> Response:
    """The response of a named curve."""
    checks.one_of("response", curve, CURVES)
    _, decode = CURVES[curve]
    return Response(decode(np.linspace(0.0, 1.0, RESPONSE_CODES)))


def known_camera_grid(rig: Any) -> tuple[int, int] | None:
    """(H, W) of the photographs of a rig, if it tells, or if a folder has one; else None."""
    if isinstance(rig, rigs.FolderRig):
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


def _check_kind(path: Path, name: str, table: Any, classes: Mapping[str, Any]) -> dict[str, Any]:
    """Check a table whose key "kind" says of which class its other keys are arguments."""
    _check_is_table(path, name, table)
    kind = table.get("kind")
    if kind not in list(classes):
        kinds = ", ".join(classes)
        raise InputError(f"{path}: [{name}] kind is {kind!r}; it must be one of {kinds}")
    return _check_table(path, name, table, classes[kind], {"kind": True})


def _check_table(
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
