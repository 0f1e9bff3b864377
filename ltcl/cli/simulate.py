# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl simulate`: a scene to be photographed without a camera, as a folder for `ltcl acquire`."""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks, report
from ltcl.cli import options, results
from ltcl.cli.command import Answer, Context
from ltcl.cli.options import option
from ltcl.errors import InputError
from ltcl.store import Record, formats

_MITSUBA = "mitsuba:"
_SCENES = ("dihedral", "trihedral", "box")
_SIZE, _GRID, _ALBEDO = 16, (24, 32), (0.7,)


def _albedo(text: str) -> tuple[float, ...]:
    try:
        albedo = tuple(float(part) for part in text.split(","))
    except ValueError:
        albedo = ()
    if len(albedo) not in (1, 3):
        raise typer.BadParameter(f"{text!r} is no albedo; write one number, or red,green,blue")
    return albedo


_SCENE = (
    "dihedral, trihedral or box; a transport file; or mitsuba: and one of these or an XML file of Mitsuba."
)
_AMBIENT = "Light of the room, where a lit white wall has 1. Default: 0.01; mitsuba has its own."
_STRATEGIES = Literal["auto", "adaptive", "pixel", "block", "hadamard"]
_Curve = Literal["linear", "srgb", "gamma2.2", "film"]
_grid = partial(option, parser=options.grid, metavar="HxW")
_Scene = Annotated[str, options.argument("SCENE", _SCENE, parser=None)]
_Size = Annotated[int | None, option("Patches along a wall of a scene. Default: 16.", min=2)]
_Grid = Annotated[tuple | None, _grid("Projector pixels: of mitsuba (24x32), or where a file lacks them.")]
_CameraGrid = Annotated[
    tuple | None, _grid("Camera pixels, if other ones: Gray code then finds which is which.")
]
_Albedo = Annotated[Any, option("Of the walls: A or R,G,B. Default: 0.7.", parser=_albedo, metavar="ALBEDO")]
_Response = Annotated[_Curve, option("Of the camera, light to code.")]
_Projector = Annotated[_Curve, option("Of the projector, code to light.")]
_Bits = Annotated[int, option("Of the photographs.", min=8, max=16)]
_Ambient = Annotated[float | None, option(_AMBIENT, min=0.0)]
_Strategy = Annotated[_STRATEGIES, option("How 'ltcl acquire' is to scan.")]
_Seed = Annotated[int, option("Of the noise.", min=0)]


def simulate(
    context: Context,
    scene: _Scene,
    out: options.Out,
    size: _Size = None,
    grid: _Grid = None,
    camera_grid: _CameraGrid = None,
    albedo: _Albedo = None,
    response: _Response = "srgb",
    projector_response: _Projector = "srgb",
    bits: _Bits = 12,
    ambient: _Ambient = None,
    strategy: _Strategy = "auto",
    seed: _Seed = 0,
) -> Answer:
    """Make a folder in which 'ltcl acquire' photographs SCENE, without a camera.

    Writes acquisition.toml, with what else it could say in comments, and truth.npz, the transport that is to
    be found again (not of mitsuba).
    """
    if (out / "transport.zarr").exists():
        raise InputError(f"{out}: holds a transport.zarr that was acquired; choose another folder")
    if (out / "acquisition.toml").exists() and not (out / "simulate.json").exists():
        raise InputError(f"{out}: holds an acquisition.toml of somebody else; choose another folder")
    from ltcl.acquisition import Project

    asked = {name: value for name, value in context.options.items() if name != "out"}
    sensor = {name: asked[name] for name in ("response", "projector_response", "bits", "seed")}
    geometry = "aligned" if camera_grid is None and not scene.endswith(".xml") else "graycode"
    text: dict[str, Any] = {
        "command": "simulate",
        "versions": report.versions(),
        "scene": scene,
        "options": asked,
    }
    with results.fill(out, text) as folder:
        context.progress("scene")
        rig = _rendered(scene, asked) if scene.startswith(_MITSUBA) else _known(folder, scene, asked)
        settings = {"geometry": geometry, "strategy": strategy}
        (folder / "acquisition.toml").write_text(_toml(rig | sensor, settings), "utf-8")
        with Project.open(folder).rig() as made:  # refuses what cannot be photographed
            text |= {"projector_grid": made.projector_grid, "channels": made.channels}

    def show() -> None:
        h, w = text["projector_grid"]
        typer.echo(f"{out}: {scene}, {h} x {w} projector pixels, {text['channels']} channel(s)")
        typer.echo(f"what it takes: ltcl acquire plan {out}\nto do it:      ltcl acquire run {out}")

    return Answer({"folder": out, **text}, show)


def _rendered(scene: str, asked: dict[str, Any]) -> dict[str, Any]:
    """The table of a rig that Mitsuba renders."""
    _refuse(asked, "size", "ambient", why="is not for mitsuba")
    scene = scene.removeprefix(_MITSUBA)
    rig: dict[str, Any] = {"kind": "mitsuba", "scene": scene, "projector_grid": asked["grid"] or _GRID}
    if scene in _SCENES:
        albedo = asked["albedo"] or _ALBEDO
        rig |= {"channels": len(albedo), "albedo": albedo if len(albedo) == 3 else albedo[0]}
    else:
        _refuse(asked, "albedo", why=f"is for {', '.join(_SCENES)}; {scene} has its own")
        rig["scene"] = str(Path(scene).resolve())
    return rig | ({"camera_grid": asked["camera_grid"]} if asked["camera_grid"] else {})


def _known(folder: Path, scene: str, asked: dict[str, Any]) -> dict[str, Any]:
    """The table of a rig around a transport, which goes into the folder."""
    from ltcl import scenes

    if scene in _SCENES:
        _refuse(asked, "grid", why="is for mitsuba and files; give --size")
        albedo = asked["albedo"] or _ALBEDO
        walls = np.array([albedo]) if len(albedo) == 3 else albedo[0]
        sides = {"sides": 5} if scene == "box" else {}
        built = getattr(scenes, scene)(asked["size"] or _SIZE, albedo=walls, **sides)
        record = Record(built.matrices(), grid=built.grid)
    else:
        _refuse(asked, "size", "albedo", why=f"is for {', '.join(_SCENES)}; a file has its own")
        if not Path(scene).suffix and not Path(scene).exists():
            known = ", ".join(_SCENES)
            raise InputError(f"SCENE is {scene!r}; it must be {known}, mitsuba:NAME or a transport file")
        record = formats.read(Path(scene))
    if isinstance(record, Record) and (asked["grid"] or record.grid is None):
        if asked["grid"] is None:
            raise InputError(f"{scene}: does not contain its grid; give --grid HxW")
        record = dataclasses.replace(record, grid=checks.grid("--grid", asked["grid"], record.shape[1]))
    formats.write(folder / "truth.npz", record)
    rig: dict[str, Any] = {"kind": "virtual", "transport": "truth.npz"}
    if asked["camera_grid"]:
        rig |= {"camera_grid": asked["camera_grid"], "camera_map": "camera.npz"}
        pixels: Any = record.camera_grid or record.grid
        formats.write(folder / "camera.npz", _camera(pixels, asked["camera_grid"]))
    return rig | {"ambient": 0.01 if asked["ambient"] is None else asked["ambient"]}


def _refuse(asked: dict[str, Any], *names: str, why: str) -> None:
    for name in names:
        if asked[name] is not None:
            raise InputError(f"--{name} is given, but it {why}")


def _camera(pixels: tuple[int, int], camera: tuple[int, int]) -> Record:
    """What each pixel of a camera in the projector's place sees."""
    from ltcl.acquisition import camera_map

    (h, w), (H, W) = pixels, camera

    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (u + 0.5) * w / W - 0.5, (v + 0.5) * h / H - 0.5

    return Record((camera_map(place, camera, pixels),), grid=pixels, camera_grid=camera)


_TOML = """\
# What 'ltcl acquire' photographs in this folder, and how. The keys of [rig] are the arguments of
# ltcl.acquisition.VirtualRig, MitsubaRig, FolderRig or LiveRig, those of [acquire] the arguments of
# ltcl.acquire; "none" stands for None. Once photographs are taken, [acquire] must stay as it is.

[rig]
{rig}# gain = 10000.0           # electrons at full scale; "none": no photon noise
# exposures = [0.1, 0.2]   # seconds that the camera offers; left out: any

[acquire]
{acquire}# geometry: "graycode" measures which projector pixel a camera pixel sees, "aligned": the same one
# strategy: "auto", "adaptive", "pixel", "block" or "hadamard"; 'ltcl acquire plan' compares them
# exposures = [0.5, 8.0]   # seconds of the photographs of each pattern; left out: chosen
# response = "linear"      # of the camera where it is known; left out: measured

# Other rigs: a projector and a camera worked by hand, with patterns and photographs in this folder,
#   [rig]
#   kind = "folder"
#   projector_grid = [48, 64]   # height, width
# or a camera on a cable before a display of this computer (extras camera and projector):
#   [rig]
#   kind = "live"
#   [rig.camera]
#   kind = "opencv"             # or "gphoto2"
#   source = 0
#   [rig.display]
#   grid = [48, 64]
#   index = 1
"""


def _toml(rig: dict[str, Any], acquire: dict[str, Any]) -> str:
    """The file, with what else it could say in comments."""
    tables = {"rig": rig, "acquire": acquire}
    lines = {
        name: "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in table.items())
        for name, table in tables.items()
    }
    return _TOML.format(**lines)
