# SPDX-License-Identifier: BSD-3-Clause
"""Without hardware: `ltcl simulate`, a scene as a folder for `ltcl acquire`; `ltcl demo`, the main result."""

from __future__ import annotations

import dataclasses
import json
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks, report
from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command, percent, table
from ltcl.cli.options import argument, option
from ltcl.device import open_device
from ltcl.errors import InputError
from ltcl.store import Record, formats

_MITSUBA = "mitsuba:"
_SCENES = ("dihedral", "trihedral", "box")
_SIDE = option("Patches along a wall; the projector gets 3 N^2 pixels.", min=4)
_SIZE, _GRID, _ALBEDO = 16, (24, 32), (0.7,)


def _albedo(text: str) -> tuple[float, ...]:
    with suppress(ValueError):
        albedo = tuple(float(value) for value in text.split(","))
        if len(albedo) in (1, 3):
            return albedo
    raise typer.BadParameter(f"{text!r} is no albedo; write one number, or red,green,blue")


_SCENE = "dihedral, trihedral, box; a transport file; or mitsuba: and one of these or an XML file of Mitsuba."
_AMBIENT = "Light of the room, where a lit white wall has 1. Default: 0.01; mitsuba has its own."
_Strategy = Literal["auto", "adaptive", "pixel", "block", "hadamard"]
_ALBEDO_HELP = "Of the walls: A or R,G,B. Default: 0.7."
_Curve = Literal["linear", "srgb", "gamma2.2", "film"]
_grid = partial(option, parser=options.grid, metavar="HxW")
_GRID_HELP = "Projector pixels: of mitsuba (24x32), or where a file lacks them."
_CAMERA_HELP = "Camera pixels, if other ones: Gray code then measures which is which."


def _rig_options(
    size: Annotated[int | None, option("Patches along a wall of a scene. Default: 16.", min=2)] = None,
    grid: Annotated[tuple | None, _grid(_GRID_HELP)] = None,
    camera_grid: Annotated[tuple | None, _grid(_CAMERA_HELP)] = None,
    albedo: Annotated[Any, option(_ALBEDO_HELP, parser=_albedo, metavar="ALBEDO")] = None,
    response: Annotated[_Curve, option("Of the camera, light to code.")] = "srgb",
    projector_response: Annotated[_Curve, option("Of the projector, code to light.")] = "srgb",
    bits: Annotated[int, option("Of the photographs.", min=8, max=16)] = 12,
    ambient: Annotated[float | None, option(_AMBIENT, min=0.0)] = None,
    strategy: Annotated[_Strategy, option("How 'ltcl acquire' is to scan.")] = "auto",
    seed: Annotated[int, option("Of the noise.", min=0)] = 0,
) -> None:
    """Of the scene and the rig before it."""


@command(_rig_options)
def simulate(
    context: Context, scene: Annotated[str, argument("SCENE", _SCENE, parser=None)], out: options.Out
) -> Answer:
    """Make a folder in which 'ltcl acquire' photographs SCENE, without a camera.

    Writes acquisition.toml, with what else it could say in comments, and truth.npz, the transport that is to
    be measured (not of mitsuba).
    """
    from ltcl.acquisition import Project
    from ltcl.cli.pictures import fill

    if (out / "transport.zarr").exists():
        raise InputError(f"{out}: holds a transport.zarr that was acquired; choose another folder")
    if (out / "acquisition.toml").exists() and not (out / "simulate.json").exists():
        raise InputError(f"{out}: holds an acquisition.toml of somebody else; choose another folder")
    asked = {name: value for name, value in context.options.items() if name != "out"}
    text: dict[str, Any] = {"command": "simulate", "versions": report.versions(), "scene": scene}
    text["options"] = asked
    with fill(out, text) as folder:
        context.progress("scene")
        rig = _rig(folder, scene, asked)
        rig |= {name: asked[name] for name in ("response", "projector_response", "bits", "seed")}
        aligned = asked["camera_grid"] is None and not scene.endswith(".xml")
        settings = {"geometry": "aligned" if aligned else "graycode", "strategy": asked["strategy"]}
        content = _TOML.format(rig=_lines(rig), acquire=_lines(settings))
        (folder / "acquisition.toml").write_text(content, "utf-8")
        with Project.open(folder).rig() as opened:  # refuses what cannot be photographed
            text |= {"projector_grid": opened.projector_grid, "channels": opened.channels}
    size = "{} x {} projector pixels".format(*text["projector_grid"])
    lines = [f"{out}: {scene}, {size}, {text['channels']} channel(s)"]
    lines += [f"what it takes: ltcl acquire plan {out}", f"to do it:      ltcl acquire run {out}"]
    return Answer({"folder": out, **text}, lines)


def _rig(folder: Path, scene: str, asked: dict[str, Any]) -> dict[str, Any]:
    """The table of a rig that Mitsuba renders, or of one around a transport, which goes into the folder."""
    from ltcl import scenes
    from ltcl.acquisition import camera_map

    source = scene.removeprefix(_MITSUBA)
    is_rendered, is_named = source != scene, source in _SCENES
    record: Any
    refused = {"size": is_rendered or not is_named, "grid": is_named and not is_rendered}
    refused |= {"albedo": not is_named, "ambient": is_rendered}
    for name, is_refused in refused.items():
        if is_refused and asked[name] is not None:
            raise InputError(f"--{name} is {asked[name]}, but {scene} takes no --{name}")
    albedo = asked["albedo"] or _ALBEDO
    is_grey = len(albedo) == 1
    rig: dict[str, Any] = {} if asked["camera_grid"] is None else {"camera_grid": asked["camera_grid"]}
    if is_rendered:
        rig |= {"kind": "mitsuba", "projector_grid": asked["grid"] or _GRID}
        rig |= {"scene": source if is_named else str(Path(source).resolve())}
        paint = {"channels": len(albedo), "albedo": albedo[0] if is_grey else albedo}
        return rig | (paint if is_named else {})
    if is_named:
        walls = albedo[0] if is_grey else np.array([albedo])
        sides = {"sides": 5} if scene == "box" else {}
        built = getattr(scenes, scene)(asked["size"] or _SIZE, albedo=walls, **sides)
        record = Record(built.matrices(), grid=built.grid)
    else:
        record = _file(scene, asked["grid"])
    formats.write(folder / "truth.npz", record)
    rig |= {"kind": "virtual", "transport": "truth.npz"}
    rig |= {"ambient": 0.01 if asked["ambient"] is None else asked["ambient"]}
    if asked["camera_grid"]:  # a camera in the projector's place
        rig |= {"camera_map": "camera.npz"}
        (H, W), (h, w) = asked["camera_grid"], record.camera_grid or record.grid
        seen = camera_map(lambda u, v: ((u + 0.5) * w / W - 0.5, (v + 0.5) * h / H - 0.5), (H, W), (h, w))
        formats.write(folder / "camera.npz", Record((seen,), grid=(h, w), camera_grid=(H, W)))
    return rig


def _file(scene: str, grid: tuple[int, int] | None) -> Any:
    """A record with a grid, or the arrays of a compressed transport."""
    if not Path(scene).suffix and not Path(scene).exists():
        known = ", ".join(_SCENES)
        raise InputError(f"SCENE is {scene!r}; it must be {known}, mitsuba:NAME or a transport file")
    record = formats.read(Path(scene))
    if record.grid is None and grid is None:
        raise InputError(f"{scene}: does not contain its grid; give --grid HxW")
    if isinstance(record, Record) and grid is not None:
        return dataclasses.replace(record, grid=checks.grid("--grid", grid, record.shape[1]))
    return record


def _lines(table: dict[str, Any]) -> str:
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in table.items())


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

# Other rigs: kind = "folder" with projector_grid = [48, 64] (height, width), worked by hand, with patterns
# and photographs in this folder; or kind = "live", a camera on a cable before a display of this computer
# (extras camera and projector), with [rig.camera] kind = "opencv" or "gphoto2", source = 0 and [rig.display]
# grid = [48, 64], index = 1.
"""


_LOOKS = {"uncompensated": "projected as it is", "colours_only": "wall colours undone, bounces left"}


@command()
def demo(
    context: Context,
    out: options.Out = Path("ltcl-demo"),
    size: Annotated[int, _SIDE] = 36,
    device: options.Device = None,
) -> Answer:
    """Compensate a picture in a coloured room corner: no hardware, no download, half a minute.

    Fills DIR with what is desired, what the walls would make of it, the pattern, the compensated result, the
    bounces of light, a convergence plot, a report and a contact sheet of all that.
    """
    opened = open_device(device)
    from ltcl import demo  # imports OpenCV and matplotlib

    def progress(step: str) -> None:
        context.progress(step, demo.STEPS.index(step), len(demo.STEPS))

    done = demo.run(out, size, device=opened, progress=progress)
    data = {"folder": done.folder, "files": done.files, **done.report}
    errors = [(_LOOKS.get(look, look), percent(error)) for look, error in data["errors"].items()]
    where = f"\n{len(done.files)} files in {out}; look at {out / 'contact_sheet.png'}"
    return Answer(data, [table(("what the viewer sees", "error"), errors), where])
